"""Decodes the compressed frames of a DICOM file to standard output, one .npy after the other: `python -m ... FILE`.

A process of its own, because decoders are C++: GDCM 3.2 ends its process on some damaged JPEGs.
"""

from __future__ import annotations

import sys
from types import SimpleNamespace

import numpy as np


def main() -> int:
    """0, or 1 with the reason in the last line on stderr."""
    from pydicom.pixels import iter_pixels

    out = SimpleNamespace(write=sys.stdout.buffer.write)    # of a file NumPy would ask where it stands; pipes stand nowhere
    try:
        for frame in iter_pixels(sys.argv[1], raw=True):
            np.lib.format.write_array(out, frame, allow_pickle=False)
    except Exception as error:      # each plug-in fails in its own way
        print(f'{type(error).__name__}:', *str(error).split(), file=sys.stderr)
        return 1
    return 0


if __name__ == '__main__':
    sys.exit(main())
