"""What is in a bag, shown from begin to end: results of a replay, with images where they were copied, or topics of a
node as they were recorded."""

from __future__ import annotations

from collections.abc import Callable

from tqdm import tqdm

from .node_view import DIAGNOSTICS, LATENCY, PLANES, TOPICS, NodeView

PATH, CLOUD = 'nav_msgs/msg/Path', 'sensor_msgs/msg/PointCloud2'
IMAGES = 'sensor_msgs/msg/Image', 'sensor_msgs/msg/CompressedImage'
RESULTS = {'backbone_points', 'backbone'}      # either will do


def namespaces(types: dict[str, str]) -> list[str]:
    """Where results are in a bag, of its topics and their types."""
    found = {topic.rpartition('/')[0] or '/' for topic, kind in types.items()
             if (topic.endswith('/backbone_points') and kind == CLOUD)
             or (topic.endswith('/backbone') and kind == PATH and not topic.endswith('ground_truth/backbone'))}
    return sorted(found)


def topics_of(namespace: str, types: dict[str, str], names: dict[str, str], images: bool) -> dict[str, str]:
    """Topic in the bag -> what it is to a NodeView; `names` are those that were remapped."""
    def place(name: str) -> str:
        other = names.get(name, name)
        return other if other.startswith('/') else f'{namespace.rstrip("/")}/{other}'

    given = {place(name): name for name, kind in TOPICS.items() if types.get(place(name)) == kind}
    if 'backbone_points' not in given.values() and types.get(place('backbone')) == PATH:
        given[place('backbone')] = 'backbone'
    for plane in PLANES:
        raw = place(f'plane_{plane}/image_raw')
        if f'plane_{plane}/overlay' not in given.values():      # it shows the image, and more
            given |= {topic: f'plane_{plane}/image_raw' for topic in (raw, f'{raw}/compressed')
                      if types.get(topic) in IMAGES}
    shown = {topic: name for topic, name in given.items() if images or not name.endswith(('/image_raw', '/overlay'))}
    return shown | {topic: topic for topic, kind in [DIAGNOSTICS] if types.get(topic) == kind}


def has_latency(bag) -> bool:
    """Whether a node wrote the bag's diagnostics; a replay knows no latency."""
    first = next(iter(bag.messages([DIAGNOSTICS[0]])), None)
    return first is not None and any(item.key == LATENCY for status in first.message.status for item in status.values)


def play(bag, views: list[tuple[NodeView, dict[str, str]]], stop: Callable[[], bool]) -> None:
    """Show a bag (of open_bag), each NodeView its topics (of topics_of), until its end or `stop()`."""
    taken: dict[str, list[tuple[NodeView, str]]] = {}
    for view, topics in views:
        for topic, name in topics.items():
            taken.setdefault(topic, []).append((view, name))
    with tqdm(bag.messages(taken), 'reading', bag.count(taken), unit='message', disable=None, leave=False) as messages:
        for recorded in messages:
            if stop():
                return
            for view, name in taken[recorded.topic]:
                view.take(name, recorded.message, recorded.log_ns)
