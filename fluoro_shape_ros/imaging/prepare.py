"""Images as the method wants them: the device dark, noise even, both planes on one sheet, and no more of them than is
needed."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from ..data import View
from ..geometry.cameras import crop, distort, isocenter, pixels_per_metre, project
from .field import field_of_view
from .parallel import both
from .silhouette import outline, shadow
from .strips import Sheet

# of an image of half the size: what a device is wider than, what it is thinner than, how far around it is compared
FINE_PX, LOCAL_PX, AROUND_PX = 1.25, 25, 61
RARE = 8.0              # standard deviations: what deviates by more counts as if by so many
REGION_PX = 80          # a tracked device moves and grows less than this from one pair to the next
WHOLE = slice(None), slice(None)    # rows and columns of an image


def dark_device(image: np.ndarray, polarity: str) -> np.ndarray:
    """The (H, W) image as float32, not negative, with a device that is darker than its surroundings; polarity is
    settled here and nowhere else."""
    full = float(np.iinfo(image.dtype).max) if image.dtype.kind == 'u' else None
    image = image.astype(np.float32)
    if full is None:
        low, high = float(image.min()), float(image.max())
        image, full = image - min(low, 0.0), high - min(low, 0.0)
    if polarity == 'auto':
        polarity = 'bright' if _is_bright(image) else 'dark'
    return full - image if polarity == 'bright' else image


def _is_bright(image: np.ndarray) -> bool:
    """Whether the thin things that stand out most in an (H, W) float32 image are brighter than what lies around them.

    What deviates from the local level counts in local standard deviations, so that neither blades nor bright parts of
    the patient outweigh a device.
    """
    small = cv2.resize(image, [-(-n // 2) for n in image.shape[::-1]], interpolation=cv2.INTER_AREA)
    field = cv2.erode(field_of_view(small, 'auto'), np.ones((LOCAL_PX, LOCAL_PX), np.uint8),
                      borderType=cv2.BORDER_CONSTANT, borderValue=255)
    detail = cv2.GaussianBlur(small, (0, 0), FINE_PX)
    detail -= cv2.blur(detail, (LOCAL_PX, LOCAL_PX))
    usual = np.sqrt(np.maximum(cv2.blur(detail * detail, (AROUND_PX, AROUND_PX)), 1e-12))
    return bool(np.sum(np.clip(detail / usual, -RARE, RARE)[field > 0]**5) > 0)


def stable_noise(image: np.ndarray, polarity: str, region: tuple[slice, slice], out: np.ndarray) -> None:
    """Write the square root of the `region` of a dark device's (H, W) image to `out`, float32: quantum noise gets the
    same variance everywhere (Anscombe)."""
    if image.dtype.kind == 'u' and polarity == 'dark':
        np.sqrt(image[region], out=out, dtype=np.float32)
    elif image.dtype.kind == 'u' and polarity != 'auto':
        np.sqrt(dark_device(image[region], polarity), out=out)
    else:       # needs the whole image's statistics
        np.sqrt(dark_device(image, polarity)[region], out=out)


def sheet_of(images: Sequence[np.ndarray], fields: Sequence[np.ndarray], views: Sequence[View], polarity: str,
             regions: Sequence[tuple[slice, slice]] = (WHOLE, WHOLE)) -> Sheet:
    """Both planes' images, or a region of each, as the method wants them."""
    parts = [crop(v, *r) for v, r in zip(views, regions)] if regions != (WHOLE, WHOLE) else views
    return Sheet.of(list(zip(images, regions)), [f[r] for f, r in zip(fields, regions)], parts,
                    lambda i, out: stable_noise(i[0], polarity, i[1], out))


def silhouettes(images: Sequence[np.ndarray], views: Sequence[View],
                radius: float) -> tuple[tuple, list[np.ndarray], Sheet]:
    """Silhouettes of a device of `radius` m as X-ray images of a dark device and their fields, which are all of them;
    and a sheet of the outlines as they are."""
    widths = [radius * pixels_per_metre(v.P, isocenter(views)[None]) for v in views]
    fields, pixels = [np.full(image.shape, 255, np.uint8) for image in images], sum(image.size for image in images)
    found = both(outline, images, widths, pixels=pixels)
    return both(shadow, found, widths, pixels=pixels), fields, Sheet.of(found, fields, views)


def region_around(view: View, points: np.ndarray, margin_px: float = REGION_PX) -> tuple[slice, slice]:
    """Rows and columns of the image within `margin_px` of the projections of (N, 3) points."""
    uv = distort(view, project(view.P, points))
    low = np.clip(np.floor(uv.min(axis=0)) - margin_px, 0, [view.width - 1, view.height - 1]).astype(int)
    high = np.clip(np.ceil(uv.max(axis=0)) + margin_px, 1, [view.width, view.height]).astype(int)
    return slice(low[1], high[1]), slice(low[0], high[0])
