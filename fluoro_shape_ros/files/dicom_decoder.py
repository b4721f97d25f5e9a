"""Decodes the first compressed frames of a DICOM file to standard output, one .npy after the other:
`python -m ... FILE COUNT`.

A process of its own, because decoders are C++: GDCM 3.2 ends its process on some damaged JPEGs.
"""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from .dicom_frames import compressed_frames
from .dicom_header import read_header


def main() -> int:
    """0, or 1 with the reason in the last line on stderr."""
    from pydicom.encaps import encapsulate
    from pydicom.pixels import iter_pixels

    # of a file NumPy would ask where it stands; pipes stand nowhere
    out = SimpleNamespace(write=sys.stdout.buffer.write)
    try:
        path = Path(sys.argv[1])
        header = read_header(path)
        for frame in compressed_frames(path, header, int(sys.argv[2])):
            header.NumberOfFrames, header.PixelData = 1, encapsulate([frame])
            for image in iter_pixels(header, raw=True):
                np.lib.format.write_array(out, image, allow_pickle=False)
    except Exception as error:      # each plug-in fails in its own way
        print(*str(error).split(), file=sys.stderr)
        return 1
    return 0


if __name__ == '__main__':
    sys.exit(main())
