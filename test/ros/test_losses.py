"""Pairs that go missing on a best-effort stream: the node says what is likely to lose them."""

import pytest

pytest.importorskip('rclpy')

import ros_client as ros
from rclpy.qos import ReliabilityPolicy

from msg_adapters.diagnostics import LOST

CROP = [pixels[:64, :64] for pixels in ros.BLANK]      # refused at once, and small enough to arrive


def test_missing_partners_are_explained(tmp_path):
    """Of three images of plane B two do not come."""
    with ros.NodeProcess(tmp_path / 'log.txt', 'reference_frame:=cell', domain=ros.OTHER) as node, \
            ros.Client(ReliabilityPolicy.BEST_EFFORT, domain=ros.OTHER) as client:
        assert client.connected(), node.log
        lost = lambda: any(s.name.endswith('pairing') and 'have no partner' in s.message    # noqa: E731
                           and LOST in s.message and s.level == b'\x01' for s in client.statuses)

        def send(planes, condition):
            client.now_ns += ros.STEP_NS
            for k in planes:
                message = ros.image_msg(CROP[k])
                message.header.stamp = ros.time_msg(client.now_ns)
                client.images[k].publish(message)
            return client.until(condition, 0.05)
        assert any(send(planes, lost) for _ in range(200)
                   for planes in ((0, 1), (0,), (0,))), [s.message for s in client.statuses[-4:]]
        whole = lambda: any(s.name.endswith('pairing') and s.level == b'\x00' for s in client.statuses)    # noqa: E731
        del client.statuses[:]
        assert any(send((0, 1), whole) for _ in range(400)), [s.message for s in client.statuses[-4:]]
