"""Sphinx makes pages of this folder: `sphinx-build -W docs build/docs`, with what the extra `docs` installs. ROS is not
needed."""

import inspect
import re
import sys
from dataclasses import is_dataclass
from enum import Enum
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from fluoro_shape_ros import __version__  # noqa: E402

project = 'fluoro_shape_ros'
copyright = 'fluoro_shape_ros maintainers'
version = release = __version__

extensions = ['myst_parser', 'sphinx.ext.autodoc']
myst_heading_anchors = 3            # links to headings work as on GitHub
html_theme = 'furo'
html_title = f'fluoro_shape_ros {release}'
default_role = 'literal'            # docstrings write `name` for code
add_module_names = False
autodoc_member_order = 'bysource'
autodoc_preserve_defaults = True
autodoc_typehints_format = 'short'


def held(cls: type) -> list[str]:
    """What a class holds, for its docstring: the values of an enumeration, or a dataclass' fields, whose shapes and
    units stand in a comment beside them, and perhaps below that."""
    if issubclass(cls, Enum):
        return ['', ', '.join(f'`{member.value}`' for member in cls)]
    fields = (re.findall(r'^    (\w+): [^#\n]*# *(.+(?:\n {5,}# .+)*)$', inspect.getsource(cls), re.MULTILINE)
              if is_dataclass(cls) else [])
    return ['', *(f':param {name}: ' + re.sub(r'\n +# ', ' ', words) for name, words in fields)]


def as_it_is_written(app, what, name, obj, options, lines):
    """Docstrings are plain text, whose indented lines are to stay as they are."""
    lines += held(obj) if what == 'class' else []
    plain, inside = [], False
    for line in lines:
        if line.startswith('    ') and not inside:
            plain += ['::', '']
        inside = line.startswith('    ') or (inside and not line)
        plain.append(line if inside else line.replace('|', r'\|'))
    lines[:] = plain


def setup(app):
    app.connect('autodoc-process-docstring', as_it_is_written)
