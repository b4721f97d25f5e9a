"""What the node listens to: subscriptions that take what a publisher offers."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from nav_msgs.msg import Path
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import QoSPolicyKind, QoSProfile, QoSReliabilityPolicy
from rclpy.qos_overriding_options import InvalidQosOverridesError, QoSOverridingOptions
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from msg_adapters.shapes import BadPath

from .pairing import PLANES

IMAGE_DEPTH, INFO_DEPTH = 5, 10
MAX_PATH_BYTES = 2**18  # some 3000 poses; making Python objects of a million would keep the node busy for a minute
RELIABILITIES = ('auto', 'reliable', 'best_effort')
_OVERRIDABLE = (QoSPolicyKind.HISTORY, QoSPolicyKind.DEPTH, QoSPolicyKind.DURABILITY)


def surviving(callback: Callable, failed: Callable[[Exception], None]) -> Callable:
    """`callback`, but an exception of it goes to `failed`: a message must not take the node with it."""
    def call(*arguments):
        try:
            callback(*arguments)
        except Exception as error:  # the last line of defence, see worker.Worker
            failed(error)
    return call


def path_of(data: bytes) -> Path:
    """The nav_msgs/Path in a serialized message. Raises BadPath where it is too long to be looked at, or damaged."""
    if len(data) > MAX_PATH_BYTES:
        raise BadPath(f'a Path of {len(data)} bytes; more than {MAX_PATH_BYTES} are not looked at')
    try:
        return deserialize_message(data, Path)
    except RuntimeError as error:
        raise BadPath('the Path is damaged') from error


class AdaptiveSubscription:
    """A subscription that is reliable, until a publisher offers only best-effort: then it is remade so, by itself.

    With no publisher left it is reliable again. `image_reliability` other than auto, or a QoS override of the
    reliability, fixes it.
    """

    def __init__(self, node: Node, msg_type, topic: str, callback: Callable, depth: int, image_reliability: str):
        self._node, self._depth = node, depth
        self._msg_type, self._topic, self._callback = msg_type, topic, callback
        self._subscription: Any = None
        wanted = _reliability(node, node.resolve_topic_name(topic), image_reliability)
        self._auto = wanted == 'auto'
        self._make(QoSReliabilityPolicy.BEST_EFFORT if wanted == 'best_effort' else QoSReliabilityPolicy.RELIABLE)

    @property
    def best_effort(self) -> bool:
        """Whether best-effort is in use."""
        return self._subscription.qos_profile.reliability == QoSReliabilityPolicy.BEST_EFFORT

    @property
    def fell_back(self) -> bool:
        """Whether best-effort is in use because of a publisher, not because anybody wanted it."""
        return self._auto and self.best_effort

    @property
    def topic(self) -> str:
        """The full name, remapped."""
        return self._subscription.topic_name

    @property
    def publishers(self) -> int:
        """How many there are, compatible or not."""
        return self._node.count_publishers(self.topic)

    def destroy(self) -> None:
        self._node.destroy_subscription(self._subscription)

    def _make(self, reliability: QoSReliabilityPolicy) -> None:
        if self._subscription is not None:
            self.destroy()
        events = SubscriptionEventCallbacks(incompatible_qos=self._incompatible, matched=self._matched)
        self._subscription = self._node.create_subscription(
            self._msg_type, self._topic, self._callback, QoSProfile(depth=self._depth, reliability=reliability),
            event_callbacks=events, qos_overriding_options=QoSOverridingOptions(_OVERRIDABLE))

    def _incompatible(self, event) -> None:
        topic = self._subscription.topic_name
        if event.last_policy_kind != QoSPolicyKind.RELIABILITY or not self._auto:
            policy = QoSPolicyKind(event.last_policy_kind).name.lower()
            self._node.get_logger().warning(f'{topic}: a publisher offers an incompatible {policy}: it is not heard')
        elif not self.best_effort:
            self._node.get_logger().warning(f'{topic}: a publisher offers only best-effort: '
                                            'taking that, images may get lost')
            self._make(QoSReliabilityPolicy.BEST_EFFORT)

    def _matched(self, event) -> None:
        if self.fell_back and event.current_count == 0 and event.current_count_change < 0:
            self._make(QoSReliabilityPolicy.RELIABLE)


def _reliability(node: Node, topic: str, image_reliability: str) -> str:
    """What the QoS override of the reliability says, else `image_reliability`.

    rclpy's own overriding would take the default it declared at first for an override when the subscription is remade.
    """
    name = f'qos_overrides.{topic}.subscription.reliability'
    if not node.has_parameter(name):
        node.declare_parameter(name, 'auto', ParameterDescriptor(description='reliable, best_effort, or auto: as '
                                                                             'image_reliability says', read_only=True))
    value = node.get_parameter(name).value
    if value not in RELIABILITIES:
        raise InvalidQosOverridesError(f'{name}: must be one of {", ".join(RELIABILITIES)}, got {value!r}')
    return image_reliability if value == 'auto' else value


class Inputs:
    """The images and camera infos of both planes; `on_image(plane, msg)` and `on_camera_info(plane, msg)` get what
    comes."""

    def __init__(self, node: Node, image_transport: str, image_reliability: str, on_image: Callable,
                 on_camera_info: Callable):
        # camera infos first: the executor takes them in this order, and an image needs its camera
        self._infos = {plane: AdaptiveSubscription(node, CameraInfo, f'plane_{plane}/camera_info',
                                                   partial(on_camera_info, plane), INFO_DEPTH, image_reliability)
                       for plane in PLANES}
        kind, suffix = (CompressedImage, '/compressed') if image_transport == 'compressed' else (Image, '')
        self._images = {}
        for plane in PLANES:    # beside the image wherever that was remapped to, as image_transport does it
            topic = node.resolve_topic_name(f'plane_{plane}/image_raw') + suffix
            self._images[plane] = AdaptiveSubscription(node, kind, topic, partial(on_image, plane), IMAGE_DEPTH,
                                                       image_reliability)
        self._publishers = dict.fromkeys(PLANES, 0)

    def destroy(self) -> None:
        for subscription in (*self._infos.values(), *self._images.values()):
            subscription.destroy()

    def count(self) -> None:
        """Look anew how many publish the images: too slow to be asked for each of them."""
        self._publishers = {plane: images.publishers for plane, images in self._images.items()}

    @property
    def infos_may_be_lost(self) -> bool:
        """Whether a camera info that was lost is not sent again."""
        return any(infos.best_effort for infos in self._infos.values())

    def known(self, plane: str) -> dict:
        """What a PlaneSummary tells of them."""
        images = self._images[plane]
        return dict(unheard=partial(self._unheard, plane),
                    reliability='best_effort' if images.best_effort else 'reliable', fell_back=images.fell_back,
                    publishers=self._publishers[plane])

    def _unheard(self, plane: str) -> str:
        """The topics of a plane that nobody publishes, in words; empty where all are published."""
        return ' and '.join(s.topic for s in (self._images[plane], self._infos[plane]) if not s.publishers)
