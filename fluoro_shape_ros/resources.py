"""Where the files of resource/ are, however the package was installed."""

from __future__ import annotations

import sys
from pathlib import Path

PACKAGE = 'fluoro_shape_ros'


def resource_path(name: str) -> Path:
    """The file `name` of resource/: in the source tree (also of symlinked and editable installs), else in the
    installation's share/.

    Raises FileNotFoundError where there is none.
    """
    here = Path(__file__).resolve()
    # pip, colcon, --user and --target all put share/ beside an ancestor of the module;
    # sys.prefix is for unusual schemes
    folders = [here.parents[1] / 'resource', *(p / 'share' / PACKAGE for p in (*here.parents, Path(sys.prefix)))]
    for folder in folders:
        if (folder / name).is_file():
            return folder / name
    raise FileNotFoundError(f'the resource file {name} is not in this installation of {PACKAGE}: '
                            'install it anew with pip or colcon build')
