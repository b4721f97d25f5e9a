"""Contact sheets: pairs of images as a person sees them, ten a sheet, with a line of text below each and nothing drawn
on them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from ..overlay import bgr

SIDE, GAP = 400, 4                      # px, of an image on a sheet, and between two
STRETCH = 0.5, 99.5                     # percentiles that become black and white
COLUMNS, ROWS = 2, 5                    # pairs
CAPTION, MARGIN = 22, 10                # px, the height of a line of text, and around a pair
FONT = dict(fontFace=cv2.FONT_HERSHEY_SIMPLEX, fontScale=0.4, thickness=1)


@dataclass(frozen=True)
class Cell:
    """A pair and what is said of it."""

    thumbnail: np.ndarray   # of `thumbnail`
    before: str             # the line begins with it ...
    note: str               # ... goes on with this, cut where there is no room ...
    after: str              # ... and ends with it
    colour: str             # #rrggbb


def thumbnail(images: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """(SIDE, 2 SIDE + GAP) uint8: both (H, W) images side by side, each stretched from its STRETCH percentiles, and
    with black around what is not square."""
    pair = np.zeros((SIDE, 2 * SIDE + GAP), np.uint8)
    for i, image in enumerate(images):
        scale = SIDE / max(image.shape)
        h, w = (max(1, round(n * scale)) for n in image.shape)
        low, high = np.percentile(image, STRETCH)
        small = cv2.resize(image.astype(np.float32), (w, h), interpolation=cv2.INTER_AREA)
        top, left = (SIDE - h) // 2, (SIDE - w) // 2 + i * (SIDE + GAP)
        pair[top:top + h, left:left + w] = np.rint(np.clip((small - low) * (255 / max(high - low, 1e-9)), 0, 255))
    return pair


def sheet(cells: Sequence[Cell]) -> np.ndarray:
    """(H, W, 3) uint8 BGR: up to COLUMNS x ROWS pairs, row by row."""
    w, h = 2 * SIDE + GAP + 2 * MARGIN, SIDE + CAPTION + 2 * MARGIN
    canvas = np.zeros((h * -(-len(cells) // COLUMNS), w * COLUMNS, 3), np.uint8)
    for k, cell in enumerate(cells):
        top, left = k // COLUMNS * h + MARGIN, k % COLUMNS * w + MARGIN
        canvas[top:top + SIDE, left:left + cell.thumbnail.shape[1]] = cell.thumbnail[..., None]
        cv2.putText(canvas, caption(cell), (left, top + SIDE + CAPTION - 6), color=bgr(cell.colour),
                    lineType=cv2.LINE_AA, **FONT)
    return canvas


def caption(cell: Cell) -> str:
    """The line below a pair: as much of the note as there is room for, in the characters that OpenCV can write."""
    note, cut = cell.note, ''
    while True:
        line = '  '.join(filter(None, (cell.before, note + cut, cell.after))).encode('ascii', 'replace').decode()
        if not note or cv2.getTextSize(line, **FONT)[0][0] <= 2 * SIDE + GAP:
            return line
        note, cut = note[:-1].rstrip(), '...'


def write(folder: Path, name: str, cells: Sequence[Cell]) -> list[Path]:
    """Write the sheets NAME_0.png, NAME_1.png ... of these pairs into `folder`; those of an earlier run go. Raises
    OSError."""
    for old in folder.glob(f'{name}_[0-9]*.png'):
        old.unlink()
    files = []
    for k in range(0, len(cells), COLUMNS * ROWS):
        files.append(folder / f'{name}_{k // (COLUMNS * ROWS)}.png')
        files[-1].write_bytes(cv2.imencode('.png', sheet(cells[k:k + COLUMNS * ROWS]))[1])
    return files
