"""What nodes publish, shown while it comes."""

from __future__ import annotations

import importlib
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial

import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions

from ..cli import ToolError
from .node_view import DIAGNOSTICS, TOPICS, NodeView

UnknownROSArgsError = rclpy_implementation.UnknownROSArgsError
STEP_S = 0.1        # between two looks at whether to end


def watch(views: dict[str, NodeView], *, ros_arguments: Sequence[str], images: bool, wait_s: float,
          stop: Callable[[], bool]) -> None:
    """Show what nodes in namespaces publish, until `stop()`.

    Raises ToolError where nothing of any of them was heard within `wait_s`, and ValueError for `ros_arguments` that ROS
    refuses.
    """
    context = Context()
    try:
        rclpy.init(args=list(ros_arguments), context=context, signal_handler_options=SignalHandlerOptions.NO)
    except (UnknownROSArgsError, RuntimeError) as error:
        # rclpy has no type of its own for arguments that it can't parse
        raise ValueError(f'ROS arguments: {str(error).partition(", at ")[0]}') from error
    executor = SingleThreadedExecutor(context=context)
    nodes = [_listen(context, executor, namespace, view, images) for namespace, view in views.items()]
    try:
        deadline, warned, unheard = time.monotonic() + wait_s, False, list(views)
        while not stop():
            executor.spin_once(timeout_sec=STEP_S)
            for namespace in [name for name in unheard if views[name].heard]:
                unheard.remove(namespace)
                print(f'fluoro_shape_view: {namespace} is heard', flush=True)
            if not warned and time.monotonic() > deadline:
                warned = True
                _complain(unheard, len(views), wait_s)
    finally:
        executor.shutdown()
        for node in nodes:
            node.destroy_node()
        context.try_shutdown()


def _listen(context: Context, executor: SingleThreadedExecutor, namespace: str, view: NodeView, images: bool):
    """A ROS node in the namespace of the one that is watched, so that remapping rules mean the same; its subscriptions
    feed `view`."""
    node = rclpy.create_node('fluoro_shape_view', namespace=namespace, context=context, start_parameter_services=False,
                             enable_rosout=False)
    take = lambda topic, msg: view.take(topic, msg, time.time_ns())     # noqa: E731
    for topic, kind in (*TOPICS.items(), DIAGNOSTICS):
        if not images and topic.endswith('/overlay'):
            continue
        package, _, name = kind.split('/')
        # what is best-effort is heard too, and a view that is slow holds nobody up
        qos = QoSProfile(depth=2 if topic.endswith('/overlay') else 10,
                         reliability=ReliabilityPolicy.BEST_EFFORT if topic.endswith('/camera_info')
                                     else ReliabilityPolicy.RELIABLE)
        node.create_subscription(getattr(importlib.import_module(f'{package}.msg'), name), topic,
                                 partial(take, topic), qos)
    executor.add_node(node)
    return node


def _complain(unheard: list[str], count: int, wait_s: float) -> None:
    names = ', '.join(unheard)
    words = (f'no node was heard in {names} within {wait_s:g} s (neither /diagnostics of one nor backbone_points nor '
             'overlays there)')
    if len(unheard) == count:
        raise ToolError(f'{words}; is it running, in this ROS_DOMAIN_ID, and is that its namespace?')
    if unheard:
        print(f'fluoro_shape_view: {words}', file=sys.stderr, flush=True)
