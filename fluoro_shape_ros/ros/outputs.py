"""What the node publishes of a pair: backbone and tip always, everything else only while somebody listens."""

from __future__ import annotations

from geometry_msgs.msg import PointStamped, PoseWithCovarianceStamped
from nav_msgs.msg import Path
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions
from sensor_msgs.msg import Image, PointCloud2
from visualization_msgs.msg import MarkerArray

from msg_adapters.images import BadImage, array_to_image
from msg_adapters.markers import rejection_to_markers, shape_to_markers
from msg_adapters.messages import ros_message
from msg_adapters.shapes import shape_to_cloud, shape_to_path_cdr, shape_to_tip, shape_to_tip_pose

from ..data import Frame, Reconstruction
from ..geometry.cameras import isocenter
from ..overlay import overlay, words
from .pairing import PLANES
from .worker import Job, decode


class Outputs:
    """The publishers of results; reliable, depth 1, and QoS overrides are allowed. Used by the worker's thread
    alone."""

    def __init__(self, node: Node):
        def publisher(kind, topic):
            return node.create_publisher(kind, topic, QoSProfile(depth=1),
                                         qos_overriding_options=QoSOverridingOptions.with_default_policies())
        self._backbone, self._tip = publisher(Path, 'backbone'), publisher(PointStamped, 'tip')
        self._pose, self._points = (publisher(PoseWithCovarianceStamped, 'tip_pose'),
                                    publisher(PointCloud2, 'backbone_points'))
        self._markers = publisher(MarkerArray, 'markers')
        self._overlays = [publisher(Image, f'plane_{plane}/overlay') for plane in PLANES]

    def answer(self, frame: Frame, result: Reconstruction) -> None:
        """Publish the shape of a result, if it has one."""
        if result.shape is not None:
            self._backbone.publish(shape_to_path_cdr(result.shape, frame.stamp_ns, frame.frame_id))
            self._tip.publish(shape_to_tip(result.shape, frame.stamp_ns, frame.frame_id, ros_message))

    def explain(self, job: Job, frame: Frame | None, result: Reconstruction) -> None:
        """Publish what else there is to say of a pair, of a rejected one too; `frame` is None where the messages were
        no frame."""
        if result.shape is not None and self._pose.get_subscription_count():
            self._pose.publish(shape_to_tip_pose(result.shape, job.stamp_ns, job.frame_id, ros_message))
        if result.shape is not None and self._points.get_subscription_count():
            self._points.publish(shape_to_cloud(result.shape, result.confidence, job.stamp_ns, job.frame_id,
                                                ros_message))
        if self._markers.get_subscription_count():
            self._markers.publish(_markers(job, frame, result))
        for plane, out in enumerate(self._overlays):
            if out.get_subscription_count():
                self._draw(out, plane, job, frame, result)

    def _draw(self, out, plane: int, job: Job, frame: Frame | None, result: Reconstruction) -> None:
        try:
            image = frame.images[plane] if frame else decode(job.images[plane])
        except BadImage:    # diagnostics say so; there is nothing to draw on
            return
        picture = overlay(image, plane, result, frame.views if frame else None)
        out.publish(array_to_image(picture, job.stamp_ns, job.frame_id, ros_message))


def _markers(job: Job, frame: Frame | None, result: Reconstruction) -> MarkerArray:
    text = '\n'.join(words(result))
    if result.shape is not None:
        return shape_to_markers(result.shape, job.config.radius, text, job.stamp_ns, job.frame_id, ros_message)
    place = isocenter(frame.views) if frame else None   # where a biplane system looks
    return rejection_to_markers(text, place, job.stamp_ns, job.frame_id, ros_message)
