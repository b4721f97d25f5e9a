"""What the report of a fault needs, in one zip file: a few seconds of the bag, the parameters, versions, the page and
what became of the pairs.

See cut_bag for what is left out. What is packed is replayed once more, so that page and outcomes are those of the bag
in the file.
"""

from __future__ import annotations

import dataclasses
import importlib.metadata
import json
import math
import os
import platform
import shutil
import sys
import tempfile
import zipfile
from pathlib import Path

import cv2

from .. import __version__
from ..cli import ToolError
from ..config import Config
from ..device import REST, Device, presets
from .cut_bag import Rename, cut, names_of, renamed
from .exports import writing
from .history import History
from .offline import Answer, Offline, Topics, span_ns
from .report import numbers, write_report
from .summary import as_json

FOLDER = 'fluoro_shape_bundle'      # in the file
DATE = (1980, 1, 1, 0, 0, 0)        # of all that is in it, the earliest that a zip file knows
PACKAGES = ('numpy', 'scipy', 'scikit-image', 'rosbags', 'mcap', 'plotly')
README = """Packed by fluoro_shape_replay --bundle. In this folder

    {command}

gives the same answers again.

bag             {pairs} pairs of images with their camera infos{more}
params.yaml     the parameters{device}
report.html     the page of that replay
outcomes.json   what became of these pairs here and in the recording that they are from
versions.json   what it was made with

Times do not say when it was recorded, and frames with a name that does not look like one are called
renamed_frame_1, ... LOOK AT THE IMAGES (in report.html, and by `ros2 bag play bag`) before you pass this on: a name
that is burnt into them is still there.
"""


def write_bundle(path: str, seconds: float, bag, config: Config, topics: Topics, window: tuple[float, float],
                 mask_s: float, history: History) -> str:
    """Pack `seconds` of a bag (of open_bag) that was replayed with `window` (start, duration in s) and `mask_s`, see
    Offline, into a new zip file.

    Returns what was packed, in one line. Raises ToolError where that can't be.
    """
    from msg_adapters.bags import BadBag, create_bag, open_bag

    what, (index, at) = reported(history)
    span, mask_ns = span_ns(bag, window), bag.start_ns + round(mask_s * 1e9)
    part = span_around(at.log_ns[0], seconds, max(span[0], bag.start_ns, mask_ns), min(span[1], bag.end_ns))
    spans = [(bag.start_ns, mask_ns), part] if mask_s else [part]
    rename = renamed()
    packed = anonymous(config, rename)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        try:
            with create_bag(folder / 'bag', 'mcap') as out:
                moved_ns, moved_log_ns = cut(bag, out, topics, config, spans, rename)
            with open_bag(folder / 'bag') as found:
                mask = max((spans[0][1] - moved_log_ns - found.start_ns) / 1e9, 0.0) if mask_s else 0.0
                command = ('fluoro_shape_replay bag --out results --params '
                           f'params.yaml{f" --mask {mask:.9f}" if mask else ""} --report page.html')
                again, seen = Offline(found, packed, names_of(config), mask_s=float(f'{mask:.9f}')), History()
                for answer in again.answers():
                    seen.take(answer)
                write_report(folder / 'report.html', seen, again, 'bag', command)
        except BadBag as error:
            raise ToolError(str(error)) from error
        outcomes = compared(history, seen, moved_ns)
        otherwise = sum(o['recording'] not in (None, o['bag']) for o in outcomes)
        texts = {'outcomes.json': as_text({'reported': {'what': what,
                                                        'stamp_s': (history.rows[index].stamp_ns - moved_ns) / 1e9,
                                                        'outcome': history.rows[index].outcome},
                                           'recording': count(history), 'bag': as_json(again.summary),
                                           'otherwise_in_bag': otherwise, 'pairs': outcomes}),
                 'versions.json': as_text(versions()), 'params.yaml': parameters(packed)}
        described = packed.described if packed.detection.device == 'device.yaml' else None
        if described is not None:
            texts['device.yaml'] = device_text(described)
        texts['README.txt'] = README.format(command=command, pairs=len(seen.rows),
                                            more=', and the pairs before them that make the mask' if mask else '',
                                            device=', with device.yaml' if described else '')
        for file, text in texts.items():
            (folder / file).write_text(text, encoding='utf-8')
        pack(path, folder)
    length = (part[1] - part[0]) / 1e9
    return (f'packed {length:.1f} s around {what} ({history.rows[index].outcome}) into {path}: {len(seen.rows)} pairs'
            + (f', {otherwise} of which come out otherwise without what was before them' if otherwise else '')
            + ', parameters, versions, page and outcomes; nothing of a patient but the images: '
              'LOOK at these, a name that is burnt into them is still there')


def reported(history: History) -> tuple[str, tuple[int, Answer]]:
    """The pair that the report is about, in words and as History has it: the first refused one, else the worst."""
    if history.unanswered:
        return 'the first refused pair', history.unanswered
    return ('the worst pair', history.worst) if history.worst else ('the first pair', history.kept[0])


def span_around(center: int, seconds: float, low: int, high: int) -> tuple[int, int]:
    """So many seconds around a log time in ns, within what there is from `low` to before `high`."""
    length = round(seconds * 1e9)
    start = max(min(center - length // 2, high - length), low)
    return start, min(start + length, high)


def anonymous(config: Config, rename: Rename) -> Config:
    """The same with the reference frame as it is called in the bundle, and a device's file of a name that says
    nothing."""
    known = config.described is None or config.detection.device in presets()
    return dataclasses.replace(config, input=dataclasses.replace(config.input,
                                                                 reference_frame=rename(config.input.reference_frame)),
                               detection=dataclasses.replace(config.detection, device=config.detection.device
                                                                                      if known else 'device.yaml'))


def parameters(config: Config) -> str:
    """All of them as a ROS parameter file."""
    import yaml

    values = {name: list(value) if isinstance(value, tuple) else value for name, value in config.values().items()}
    return yaml.safe_dump({'/**': {'ros__parameters': values}}, sort_keys=False)


def device_text(device: Device) -> str:
    """The file that describes a device, without its comments."""
    import yaml

    def entry(part) -> dict:
        given = {name: value for name, value in dataclasses.asdict(part).items()
                 if name not in ('lumen', 'every') or value}
        material = given.pop('material')
        if given['length'] == REST:
            given['length'] = 'rest'
        return given | ({'material': material} if isinstance(material, str) else {'attenuation': material})

    parts = {'segments': device.segments, 'bands': device.bands, 'disks': device.disks}
    return yaml.safe_dump({name: [entry(part) for part in given] for name, given in parts.items() if given},
                          sort_keys=False)


def versions() -> dict:
    """Of what it was made with; nothing that names the machine or its user."""
    def version(*names: str) -> str | None:
        for name in names:
            try:
                return importlib.metadata.version(name)
            except importlib.metadata.PackageNotFoundError:
                continue
        return None

    return {'fluoro_shape_ros': __version__, 'python': platform.python_version(), 'opencv': cv2.__version__,
            **{name: version(name) for name in PACKAGES}, 'rclpy': version('rclpy', 'ros-jazzy-rclpy'),
            'ros_distro': os.environ.get('ROS_DISTRO'), 'rmw': os.environ.get('RMW_IMPLEMENTATION'),
            'system': f'{sys.platform} {platform.machine()}', 'cores': os.cpu_count()}


def count(history: History) -> dict:
    """Pairs and how many came to what."""
    names = [row.outcome for row in history.rows]
    return {'pairs': len(names), 'outcomes': {name: names.count(name) for name in dict.fromkeys(names)}}


def compared(history: History, seen: History, moved_ns: int) -> list[dict]:
    """Of every pair that was packed, what it came to in the bundle's bag and in the recording, None where it was none
    there."""
    before = {row.stamp_ns - moved_ns: row.outcome for row in history.rows}
    return [{'stamp_s': row.stamp_ns / 1e9, 'bag': row.outcome, 'recording': before.get(row.stamp_ns),
             'reason': row.detail, 'confidence': numbers([row.confidence], 6)[0],
             'tip_m': None if math.isnan(row.tip[0]) else list(row.tip)} for row in seen.rows]


def as_text(content: dict) -> str:
    return json.dumps(content, indent=1, allow_nan=False)


def pack(path: str, folder: Path) -> None:
    """Put all files below a folder into a new zip file, which goes again where that fails. Raises ToolError."""
    with writing(path), zipfile.ZipFile(path, 'x', zipfile.ZIP_DEFLATED) as packed:
        try:
            for file in sorted(file for file in folder.rglob('*') if file.is_file()):
                entry = zipfile.ZipInfo(f'{FOLDER}/{file.relative_to(folder).as_posix()}', DATE)
                entry.compress_type, entry.external_attr, entry.file_size = (zipfile.ZIP_DEFLATED, 0o644 << 16,
                                                                             file.stat().st_size)
                with file.open('rb') as source, packed.open(entry, 'w') as target:
                    shutil.copyfileobj(source, target, 2**20)
        except BaseException:
            Path(path).unlink(missing_ok=True)
            raise
