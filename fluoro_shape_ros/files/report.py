"""One page that shows what became of a replay; everything is in the file, nothing comes from a network. Needs plotly
(extra `report`)."""

from __future__ import annotations

import base64
import json
import math
from pathlib import Path

import cv2
import numpy as np

from msg_adapters.shapes import _worst_sigma

from .. import __version__
from ..config import Config, fields
from ..data import Shape
from ..overlay import EPIPOLAR, FOUND, SEEN, TIP, overlay
from ..resources import resource_path
from .exports import writing
from .history import History
from .offline import Answer, Offline

TEMPLATE = 'replay_report.html'
POINTS = 101        # of a backbone in the page
UNIT = 1e5          # 1/m: coordinates are whole hundredths of a millimetre
OVERLAY_PX = 2048   # longer side of an overlay, at most
QUALITY = 80        # of its JPEG: noise takes most of it
REFUSED = 3         # outcomes without a result of which a pair is shown


def write_report(path, history: History, offline: Offline, bag: str, command: str = '') -> None:
    """Write the page of a replay of `bag` to a new file; `command` is the line that asked for it. Raises ToolError
    where that can't be."""
    from plotly.offline import get_plotlyjs

    before, _, rest = resource_path(TEMPLATE).read_text(encoding='utf-8').partition('/*PLOTLY*/')
    middle, _, after = rest.partition('/*DATA*/')
    # "</" would end the script that the data is in
    data = json.dumps(page_data(history, offline, Path(bag).name, command), allow_nan=False,
                      separators=(',', ':')).replace('</', '<\\/')
    with writing(path), Path(path).open('x', encoding='utf-8') as file:
        file.writelines((before, get_plotlyjs(), middle, data, after))


def page_data(history: History, offline: Offline, name: str, command: str = '') -> dict:
    """All that the page shows; lengths in mm but where the key says otherwise, None: not known."""
    rows = history.rows
    begin = rows[0].stamp_ns
    kept = [(k, a.result.shape) for k, a in history.kept]
    config = history.kept[0][1].job.config
    return {
        'version': __version__, 'command': command,
        'strokes': {'backbone': FOUND, 'seen': SEEN, 'tip': TIP, 'epipolar': EPIPOLAR},
        'min_confidence': config.plausibility.min_confidence if config.curve.method == 'spline' else None,
        'name': name, 'frame': history.kept[0][1].job.frame_id, 'begin_s': begin / 1e9, 'lost': lost(offline),
        'parameters': changed(config), 'calibration': str(offline.summary.calibration),
        't': numbers([(r.stamp_ns - begin) / 1e9 for r in rows], 4),
        'outcome': [', '.join((r.outcome, *r.warnings)) for r in rows],
        'detail': [r.detail for r in rows], 'ms': numbers([r.seconds * 1e3 for r in rows], 2),
        'length': numbers([r.length * 1e3 for r in rows], 2), 'sigma': numbers([r.sigma * 1e3 for r in rows], 3),
        'tip': [numbers([r.tip[axis] * 1e3 for r in rows], 2) for axis in range(3)],
        'residual_px': [numbers([r.residual_px[plane] for r in rows], 3) for plane in range(2)],
        'confidence': numbers([r.confidence for r in rows], 3), 'kept': [k for k, _ in kept], 'unit': 1e3 / UNIT,
        'shapes': [None if shape is None else curve(shape) for _, shape in kept],
        'overlays': [o for o in (picture(*entry, offline) for entry in shown(history)) if o],
    }


def shown(history: History) -> list[tuple[str, tuple[int, Answer] | None]]:
    """The pairs whose overlays are on the page, with titles."""
    others = list(history.refused.items())[1:REFUSED]
    return [('worst answered', history.worst), ('median', history.median), ('first unanswered', history.unanswered),
            *((f'first {outcome.replace("_", " ")}', entry) for outcome, entry in others)]


def curve(shape: Shape) -> list[list[int | None]]:
    """x, y, z in units of 1 / UNIT m, each as the first value and the steps from there, and sigma in micrometres; base
    to tip."""
    at = np.unique(np.linspace(0, len(shape.points) - 1, POINTS).round().astype(int))
    points = np.round(shape.points[at] * UNIT).astype(int)
    return [*np.diff(points, axis=0, prepend=0).T.tolist(), numbers(_worst_sigma(shape.covariance[at]) * 1e6, None)]


def picture(title: str, entry: tuple[int, Answer] | None, offline: Offline) -> dict | None:
    """The overlays of both planes of a pair as JPEG data; None where there is none."""
    frame = entry and offline.frame_of(entry[1])
    if not frame:
        return None
    images = []
    for plane, image in enumerate(frame.images):
        drawn = overlay(image, plane, entry[1].result, frame.views)
        scale = min(1.0, OVERLAY_PX / max(drawn.shape[:2]))
        drawn = cv2.resize(drawn, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        images.append('data:image/jpeg;base64,'
                      + base64.b64encode(cv2.imencode('.jpg', drawn, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1]).decode())
    return {'title': title, 'pair': entry[0], 'images': images}


def lost(offline: Offline) -> dict[str, int]:
    """What became of images that are in no answer."""
    c = offline.summary.counts
    counted = {'pairs in the mask': offline.summary.masked, 'images unpaired': c.unpaired, 'duplicates': c.duplicates,
               'out of order': c.out_of_order, 'without a stamp': c.unstamped, 'jumps back in time': c.jumps}
    return {what: n for what, n in counted.items() if n}


def changed(config: Config) -> list[str]:
    """The parameters that are not as by default."""
    values = config.values()
    return [f'{f.name} = {values[f.name]} {f.metadata["unit"]}'.strip()
            for f in fields() if values[f.name] != f.default]


def numbers(values, digits: int | None) -> list[float | int | None]:
    """Rounded, whole for None; NaN becomes None, for which JSON has a word."""
    return [None if not math.isfinite(v) else round(v, digits) for v in map(float, values)]
