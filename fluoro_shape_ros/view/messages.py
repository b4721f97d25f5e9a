"""What only a view reads of messages: overlays with their colours, the points of a backbone."""

from __future__ import annotations

import numpy as np

from msg_adapters.images import BadImage, image_to_array
from msg_adapters.shapes import BadPath

from ..overlay import stretched


def received_shape(msg) -> tuple[int, int]:
    """(H, W) of the images of a sensor_msgs/CameraInfo, roi and binning counted."""
    return tuple((part or whole) // max(binning, 1)
                 for part, whole, binning in ((msg.roi.height, msg.height, msg.binning_y),
                                              (msg.roi.width, msg.width, msg.binning_x)))


def coloured(msg) -> np.ndarray:
    """(H, W, 3) BGR or (H, W) grey pixels of an overlay, a sensor_msgs/Image. Raises BadImage."""
    if msg.encoding != 'bgr8':
        return stretched(image_to_array(msg))
    size = msg.height * msg.step
    if len(msg.data) != size or msg.step < 3 * msg.width or not size:
        raise BadImage(f'an overlay of {msg.width}x{msg.height} pixels with {len(msg.data)} bytes')
    return np.frombuffer(msg.data, np.uint8).reshape(msg.height, msg.step)[:, :3 * msg.width].reshape(msg.height,
                                                                                                      msg.width, 3)


def cloud_to_rows(msg) -> dict[str, np.ndarray]:
    """Points (N, 3), sigma (N,) and confidence (N,) of a `backbone_points`. Raises BadPath where it is none."""
    at = {field.name: field.offset for field in msg.fields}
    wanted = ('x', 'y', 'z', 'sigma')
    if (not set(wanted) <= at.keys() or msg.width < 2 or len(msg.data) != msg.width * msg.point_step
            or max(at.values()) + 4 > msg.point_step):
        raise BadPath('not the points of a backbone')
    names = [name for name in (*wanted, 'confidence') if name in at]
    order = '>' if msg.is_bigendian else '<'
    rows = np.frombuffer(msg.data, np.dtype({'names': names, 'formats': [f'{order}f4'] * len(names),
                                             'offsets': [at[name] for name in names], 'itemsize': msg.point_step}))
    points = np.stack([rows[name].astype(float) for name in 'xyz'], axis=1)
    if not np.isfinite(points).all():
        raise BadPath('points that are not finite')
    return {'points': points, 'sigma': rows['sigma'].astype(float),
            'confidence': (rows['confidence'] if 'confidence' in names else np.full(len(rows), np.nan)).astype(float)}
