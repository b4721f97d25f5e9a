"""A part of a recorded bag as a bag of its own: all that its pairs need, and nothing that says whose it is but the
images themselves.

Only what a reconstruction reads is taken, under the node's own topic names. Times are moved so that no date is left,
frames get other names where theirs do not look like such, and compressed images are written anew without what a file
may say of itself.
"""

from __future__ import annotations

import heapq
import os
import platform
import re
from bisect import bisect_left, bisect_right
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2

from msg_adapters.cameras import BadCameraInfo
from msg_adapters.images import BadImage, compressed_to_array
from msg_adapters.messages import stamp_ns

from ..config import Config
from ..ros.pairing import PLANES
from ..ros.worker import checked_camera
from .offline import Topics
from .recorded_tf import NAMES as TF
from .recorded_tf import TF_TYPE

# where the earliest image is moved to: a day after 1970, so that older poses and camera infos still lie before it
BEGIN_NS = 100_000 * 10**9
IMAGE, COMPRESSED, INFO, PATH = ('sensor_msgs/msg/Image', 'sensor_msgs/msg/CompressedImage',
                                 'sensor_msgs/msg/CameraInfo', 'nav_msgs/msg/Path')
PREDICTION = '/predicted_backbone'
FRAME = re.compile(r'[A-Za-z]\w{0,39}(/\w{1,39}){0,3}', re.ASCII)
DIGITS = re.compile(r'\d{4}')   # dates and numbers of patients have as many
WORD = re.compile(r'[\w;: ]{0,40}', re.ASCII)       # of an encoding or a distortion model
SIGNATURE = 8                   # bytes, what is left of a compressed image that is none
Span = tuple[int, int]          # log times in ns, from and before which
Rename = Callable[[str], str]


@dataclass(frozen=True)
class Held:
    """What holds for images around it: a camera info, a transform, or a prediction."""

    stamp_ns: int
    log_ns: int
    topic: str          # in the new bag
    message: Any        # of a transform, that alone


def renamed() -> Rename:
    """Frame ids as they are where they look like names of frames, else renamed_frame_1, ...: a name with spaces, marks
    or many digits, or this user's or machine's."""
    own = {word.lower() for name in (Path(os.path.expanduser('~')).name, platform.node())
           for word in (name, name.partition('.')[0]) if word}
    known: dict[str, str] = {}

    def name(frame_id: str) -> str:
        bare = frame_id.lstrip('/')
        words = {bare.lower(), *re.split('[/_]', bare.lower())}
        if not bare or FRAME.fullmatch(bare) and not DIGITS.search(bare) and not words & own:
            return frame_id
        return known.setdefault(bare, f'renamed_frame_{len(known) + 1}')

    return name


def names_of(config: Config) -> Topics:
    """Where `cut` puts images, camera infos and poses."""
    suffix = '/compressed' if config.input.image_transport == 'compressed' else ''
    return Topics({f'/plane_{p}/image_raw{suffix}': p for p in PLANES}, {f'/plane_{p}/camera_info': p for p in PLANES},
                  {f'/{name}': name for name in TF} if config.input.geometry == 'tf' else {})


def cut(bag, out, topics: Topics, config: Config, spans: list[Span], rename: Rename) -> tuple[int, int]:
    """Copy the images in `spans` (ascending, apart) of a bag (of open_bag) and what holds for them into `out`
    (of create_bag), from BEGIN_NS on.

    Returns by how many ns stamps and log times were moved back. `topics` are those of `bag`, `config` what they are
    replayed with.
    """
    names = names_of(config)
    images, infos = ({plane: topic for topic, plane in named.items()} for named in (names.images, names.infos))
    times = [[(r.log_ns, stamp_ns(r.message)) for r in bag.messages(topics.images, *span)] for span in spans]
    stamps = [[stamp for _, stamp in found if stamp] for found in times]      # 0 means that there is none
    around = [(min(found), max(found)) for found in stamps if found]
    early = min((low for low, _ in around), default=BEGIN_NS) - BEGIN_NS
    first, last = (pick((log for found in times for log, _ in found), default=spans[0][0]) for pick in (min, max))
    held = [*_cameras(bag, topics, infos, config, around), *_poses(bag, topics, config, around),
            *_predictions(bag, around)]
    for topic in images.values():
        out.declare(topic, COMPRESSED if config.input.image_transport == 'compressed' else IMAGE)
    for topic, kind in {**dict.fromkeys(infos.values(), INFO), **dict.fromkeys(names.tf, TF_TYPE),
                        **{h.topic: PATH for h in held if h.topic == PREDICTION}}.items():
        out.declare(topic, kind)

    def moved(header, static: bool = False):
        stamp = stamp_ns(header)
        sec, nanosec = divmod(max(stamp - early, 1) if stamp and not static else 0, 10**9)
        return replace(header, stamp=replace(header.stamp, sec=sec, nanosec=nanosec), frame_id=rename(header.frame_id))

    def written(h: Held):
        if h.topic == PREDICTION:
            return replace(h.message, header=moved(h.message.header),
                           poses=[replace(p, header=moved(p.header)) for p in h.message.poses])
        if h.topic in names.infos:
            return replace(h.message, header=moved(h.message.header),
                           distortion_model=_plain(h.message.distortion_model))
        child = replace(h.message, header=moved(h.message.header, h.topic == '/tf_static'),
                        child_frame_id=rename(h.message.child_frame_id))
        return out.new(TF_TYPE, transforms=[child])

    held = sorted((replace(h, log_ns=min(max(h.log_ns, first), last)) for h in held), key=lambda h: h.log_ns)
    pictures = ((r.log_ns, images[topics.images[r.topic]], r) for span in spans
                for r in bag.messages(topics.images, *span))
    for log, topic, thing in heapq.merge(((h.log_ns, h.topic, h) for h in held), pictures, key=lambda entry: entry[0]):
        message = written(thing) if isinstance(thing, Held) else _picture(thing.message, moved(thing.message.header))
        out.write(topic, message, log - first + BEGIN_NS)
    return early, first - BEGIN_NS


def _picture(message, header):
    """An image with another header, and with no words in it but its encoding."""
    if hasattr(message, 'encoding'):
        return replace(message, header=header, encoding=_plain(message.encoding))
    try:
        data = cv2.imencode('.png', compressed_to_array(message))[1].ravel()
    except BadImage:
        data = message.data[:SIGNATURE]
    return replace(message, header=header, format='png', data=data)


def _plain(text: str) -> str:
    return text if WORD.fullmatch(text) else 'unnamed'


def _cameras(bag, topics: Topics, infos: dict[str, str], config: Config, around: list[Span]) -> list[Held]:
    """Valid and refused ones apart, so that what held still does."""
    found = defaultdict(list)
    for r in bag.messages(topics.infos):
        plane = topics.infos[r.topic]
        try:
            checked_camera(r.message, config, plane)
            valid = True
        except BadCameraInfo:
            valid = False
        found[plane, valid].append(Held(stamp_ns(r.message), r.log_ns, infos[plane], r.message))
    return _needed(found, around)


def _poses(bag, topics: Topics, config: Config, around: list[Span]) -> list[Held]:
    """The transforms of the cameras' frames and of all above them."""
    if not topics.tf:
        return []
    found, parents = defaultdict(list), {}
    for r in bag.messages([topic for topic in topics.tf if topic in bag.types()]):
        for t in r.message.transforms:
            child, parent, kind = t.child_frame_id.lstrip('/'), t.header.frame_id.lstrip('/'), topics.tf[r.topic]
            if kind == 'tf_static':     # the last one holds, whatever its stamp
                found[child, parent, kind].clear()
            found[child, parent, kind].append(Held(stamp_ns(t), r.log_ns, f'/{kind}', t))
            parents.setdefault(child, set()).add(parent)
    wanted = {config.input.reference_frame.lstrip('/'),
              *(r.message.header.frame_id.lstrip('/') for r in bag.messages(topics.infos))}
    while more := {above for frame in wanted for above in parents.get(frame, ())} - wanted:
        wanted |= more
    return _needed({key: entries for key, entries in found.items() if key[0] in wanted}, around)


def _predictions(bag, around: list[Span]) -> list[Held]:
    """Of the topic of that name, in whatever namespace, if there is one."""
    topics = [topic for topic, kind in bag.types().items() if kind == PATH and f'/{topic}'.endswith(PREDICTION)]
    return _needed({'': [Held(stamp_ns(r.message), r.log_ns, PREDICTION, r.message) for r in bag.messages(topics[:1])]},
                   around)


def _needed(found: dict[Any, list[Held]], around: list[Span]) -> list[Held]:
    """By key: what is stamped within a span of stamps, the last before it and the first after it."""
    return [h for entries in found.values() for h in _of_one(sorted(entries, key=lambda h: h.stamp_ns), around)]


def _of_one(entries: list[Held], around: list[Span]) -> Iterator[Held]:
    stamps, begin = [h.stamp_ns for h in entries], 0
    for low, high in around:
        start, stop = max(bisect_left(stamps, low) - 1, begin), bisect_right(stamps, high) + 1
        yield from entries[start:stop]
        begin = max(begin, min(stop, len(entries)))
