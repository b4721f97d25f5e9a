"""A ROS node beside the one that is watched: what demos and measurements publish and listen with."""

from __future__ import annotations

from typing import ClassVar, Self

import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions


class OwnNode:
    """A context manager: while it lasts there is a node NAME in a ROS context of its own; what comes is heard while it
    spins, by one thread."""

    NAME: ClassVar[str]

    def __enter__(self) -> Self:
        self._context = Context()
        rclpy.init(args=[], context=self._context, signal_handler_options=SignalHandlerOptions.NO)
        self._node = rclpy.create_node(self.NAME, context=self._context, start_parameter_services=False)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._connect()
        return self

    def __exit__(self, *_) -> None:
        self._executor.shutdown()
        self._node.destroy_node()
        self._context.try_shutdown()

    def _connect(self) -> None:
        """Make what the node publishes, hears and serves."""
        raise NotImplementedError

    def spin(self, seconds: float) -> None:
        """Serve what has come, or wait for something to come for at most `seconds`."""
        self._executor.spin_once(timeout_sec=seconds)
