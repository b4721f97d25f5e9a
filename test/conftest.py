"""What the tests of the adapters share."""

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
