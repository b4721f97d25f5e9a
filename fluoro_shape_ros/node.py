"""The process around the node: arguments, signals, exit codes. ROS is imported only once the arguments are read."""

from __future__ import annotations

import argparse
import gc
import os
import re
import signal
import sys

from . import cli
from .config import ConfigError, fields
from .ros.reconstructor import Reconstructor

PROG = 'fluoro_shape_node'
ROS_PACKAGES = ('rclpy', 'diagnostic_msgs', 'geometry_msgs', 'nav_msgs', 'sensor_msgs', 'std_srvs',
                'visualization_msgs')
STOP_S = 1.0    # for the pair at work when the node is told to end
SIGNALS = signal.SIGINT, signal.SIGTERM
HANG_UP = getattr(signal, 'SIGHUP', None)      # Windows has none


def main(argv=None) -> int:
    """Run the node; the exit code: 0 after SIGINT, SIGTERM or SIGHUP, 1 without ROS (one line), 2 for unusable
    arguments (one line)."""
    # From rclpy.init on its own handlers end the spinning; Python's must not throw into whatever runs just then.
    told_to_stop = []       # by which signals; no threading.Event: its lock would be waited for for ever where one
                            # signal comes amid another
    for number in SIGNALS:
        signal.signal(number, lambda number, _: told_to_stop.append(number))
    if HANG_UP and signal.getsignal(HANG_UP) is not signal.SIG_IGN:     # as nohup has it
        signal.signal(HANG_UP, lambda *_: os.kill(os.getpid(), signal.SIGTERM))     # of which rclpy knows
    argv = sys.argv[1:] if argv is None else list(argv)
    try:
        return cli.run(lambda _: _run(argv, told_to_stop), _parser(), own_arguments(argv))
    finally:
        # Python gives them their defaults back while it is taken down, and a second one would end it by itself
        for number in filter(None, (*SIGNALS, HANG_UP)):
            signal.signal(number, signal.SIG_IGN)


def own_arguments(argv: list[str]) -> list[str]:
    """`argv` without what is between --ros-args and -- or the end: that is for ROS."""
    own, for_ros = [], False
    for argument in argv:
        if argument == '--ros-args':
            for_ros = True
        elif for_ros and argument == '--':
            for_ros = False
        elif not for_ros:
            own.append(argument)
    return own


def _parser() -> argparse.ArgumentParser:
    lines = []
    for f in fields():
        unit = f', {f.metadata["unit"]}' if f.metadata['unit'] else ''
        default = list(f.default) if f.metadata['element'] else f.default     # type: ignore[arg-type]
        lines.append(f'  {f.name}: {f.metadata["description"]} (default {default!r}{unit})')
    return argparse.ArgumentParser(
        PROG, usage=f'{PROG} [-h] [--ros-args -p PARAMETER:=VALUE ... -r TOPIC:=OTHER ...]',
        formatter_class=argparse.RawDescriptionHelpFormatter,
        description='Reconstruct backbone and tip of a continuum device from two synchronized fluoroscopy streams.\n\n'
                    'Listens to plane_a/image_raw, plane_a/camera_info, plane_b/image_raw, plane_b/camera_info, '
                    'predicted_backbone;\n'
                    'publishes backbone, tip, tip_pose, backbone_points, markers, plane_a/overlay, plane_b/overlay, '
                    '/diagnostics;\nserves ~/reset, ~/enable, ~/capture_mask, ~/clear_mask.',
        epilog='parameters:\n' + '\n'.join(lines))


def _run(argv: list[str], told_to_stop: list[int]) -> int:
    # its process loads what it needs while this one loads ROS, and is begun before there are threads
    with Reconstructor() as reconstructor:
        return _run_node(argv, told_to_stop, reconstructor)


def _run_node(argv: list[str], told_to_stop: list[int], reconstructor: Reconstructor) -> int:
    for package in ROS_PACKAGES:
        cli.need(package, 'ros')
    import rclpy
    from rclpy.exceptions import ParameterException
    from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
    from rclpy.impl.implementation_singleton import rclpy_implementation
    from rclpy.qos_overriding_options import InvalidQosOverridesError

    from .ros.node import FluoroShapeNode
    from .ros.transforms import TfMissing
    try:
        rclpy.init(args=argv)
        node, executor = FluoroShapeNode(reconstructor), SingleThreadedExecutor()
    except rclpy_implementation.UnknownROSArgsError as error:
        return _refuse(f'unknown ROS arguments {error}')
    except (ConfigError, InvalidQosOverridesError) as error:
        rclpy.try_shutdown()
        return _refuse(error)
    except ParameterException as error:
        # of those that every node has, which rclpy checks; the name stands in its text twice
        rclpy.try_shutdown()
        return _refuse(str(error).rpartition(': ')[0])
    except TfMissing as error:
        rclpy.try_shutdown()
        raise cli.ToolError(error) from error
    except RuntimeError as error:   # rclpy has no type of its own for arguments that it can't parse
        # a signal has shut it down while the node was being made
        if told_to_stop or 'context is invalid' in str(error):
            return 0
        rclpy.try_shutdown()
        message = re.sub(r',? at \S+:\d+', '', str(error))     # without places in ROS's sources
        if not any(word in message for word in ('parse', 'QoS')):
            raise cli.ToolError(message) from error
        return _refuse(message)
    executor.add_node(node)
    # what the imports left stays anyway: to look through all of it now and then would hold up a pair for some 50 ms
    gc.freeze()
    try:
        if not told_to_stop:    # it may have come before rclpy's handlers
            executor.spin()
    except (ExternalShutdownException, rclpy_implementation.RCLError):
        if rclpy.ok():      # else the signal came between rclpy's look at the context and its use
            raise
    finally:
        ended = node.stop(STOP_S)
        rclpy.try_shutdown()
        # a thread deep in numpy or OpenCV can't be interrupted, and must not run on while Python is taken down
        if not ended:
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(0)
        node.destroy_node()
    return 0


def _refuse(message) -> int:
    print(f'{PROG}: {" ".join(str(message).split())}', file=sys.stderr)
    return 2


if __name__ == '__main__':
    sys.exit(main())
