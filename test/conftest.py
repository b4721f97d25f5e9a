"""What tests share."""

import os
import signal

# as the package sets it, which tests that load numpy first would miss: with more threads BLAS rounds otherwise than
# other processes
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

import pytest

from msg_adapters.messages import bag_message, ros_message


@pytest.fixture(params=['ros', 'bag'])
def new(request):
    """A factory of messages: rclpy's, then those of rosbags."""
    if request.param == 'ros':
        pytest.importorskip('rclpy')
        return ros_message
    typesys = pytest.importorskip('rosbags.typesys')
    return bag_message(typesys.get_typestore(typesys.Stores.ROS2_JAZZY))


@pytest.fixture(scope='session', autouse=True)
def this_machine_only():
    """No test hears or disturbs another machine."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
        yield


@pytest.fixture(scope='session', autouse=True)
def signals_are_heard():
    """By what the tests start, also where the tests themselves run in the background (Ctrl-C ignored) or under nohup
    (SIGHUP ignored)."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:
        signal.signal(signal.SIGHUP, signal.SIG_DFL)
