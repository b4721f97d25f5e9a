"""Results of a replay for other programs: a CSV table and NumPy arrays. Units are in the names; what is not known is
empty or NaN.

Nothing in them depends on timing: the same bag gives the same bytes.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from msg_adapters.shapes import _worst_sigma

from ..cli import ToolError
from ..data import Shape

COLUMNS = ('stamp_s', 'outcome', 's_m', 'x_m', 'y_m', 'z_m', 'sigma_m', 'residual_a_px', 'residual_b_px', 'reason',
           'confidence')


@contextmanager
def writing(path) -> Iterator[None]:
    """Makes a full disk or a missing permission a ToolError that names the file."""
    try:
        yield
    except FileExistsError:
        raise ToolError(f'{path} exists already and is not overwritten') from None
    except OSError as error:
        raise ToolError(f'{path}: can\'t be written ({error.strerror or error})') from error


def rows_of(shape: Shape) -> np.ndarray:
    """(N, 7) s, x, y, z, sigma in the worst direction (m) and residuals in plane A and B (px) of each backbone point;
    NaN: not known."""
    return np.c_[shape.s, shape.points, _worst_sigma(shape.covariance), shape.residuals_px]


class Table:
    """A CSV file: a row a backbone point, base to tip; a rejected pair has one row, with the reason and no number but
    the confidence."""

    def __init__(self, path):
        self._path, self._file = path, None

    def take(self, answer) -> None:
        """Append the result of a pair."""
        stamp, result = '{}.{:09d}'.format(*divmod(answer.job.stamp_ns, 10**9)), answer.result
        confidence = _number(result.confidence)
        if result.shape is None:
            lines = [f'{stamp},{result.outcome.value},,,,,,,,"{_one_line(result.detail)}",{confidence}']
        else:
            lines = [f'{stamp},{result.outcome.value},{",".join(map(_number, row))},,{confidence}'
                     for row in rows_of(result.shape).tolist()]
        with writing(self._path):
            if self._file is None:      # not before there is something to write
                self._file = Path(self._path).open('x', encoding='utf-8', newline='')
                lines.insert(0, ','.join(COLUMNS))
            self._file.write('\r\n'.join(lines) + '\r\n')

    def close(self) -> None:
        if self._file is not None:
            with writing(self._path):
                self._file.close()


class Arrays:
    """An NPZ file (numpy.load, without pickle): arrays over the pairs and over the backbone points of all of them.

    Of the P pairs: `stamp_ns`, `outcome`, `reason` and `confidence`. Of the N points, base to tip, pair after pair:
    `pair` (index of the pair), `s_m`, `points_m` (N, 3), `sigma_m`, `residual_px` (N, 2; plane A, B). `frame_id` names
    the reference frame.
    """

    def __init__(self, path):
        self._path = path
        self._pairs, self._points, self._frame_id = [], [], ''

    def take(self, answer) -> None:
        """Keep the result of a pair."""
        result = answer.result
        if result.shape is not None:
            self._points.append((len(self._pairs), rows_of(result.shape)))
        self._pairs.append((answer.job.stamp_ns, result.outcome.value, _one_line(result.detail), result.confidence))
        self._frame_id = self._frame_id or answer.job.frame_id

    def close(self) -> None:
        """Write the file, if there were any pairs."""
        if not self._pairs:
            return
        stamps, outcomes, reasons, confidences = zip(*self._pairs)
        points = np.concatenate([rows for _, rows in self._points]) if self._points else np.empty((0, 7))
        pairs = (np.repeat([pair for pair, _ in self._points], [len(rows) for _, rows in self._points])
                 if self._points else [])
        with writing(self._path), Path(self._path).open('xb') as file:
            np.savez_compressed(file, stamp_ns=np.array(stamps, np.int64), outcome=np.array(outcomes, str),
                                reason=np.array(reasons, str), confidence=np.array(confidences, float),
                                frame_id=np.array(self._frame_id), pair=np.array(pairs, np.int64), s_m=points[:, 0],
                                points_m=points[:, 1:4], sigma_m=points[:, 4], residual_px=points[:, 5:])


def _number(value: float) -> str:
    """Nanometres are enough, and NaN is an empty cell."""
    return '' if value != value else f'{value:.9f}'


def _one_line(text: str) -> str:
    return ' '.join(text.replace('"', '\'').split())
