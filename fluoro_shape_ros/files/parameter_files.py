"""Parameters from the command line and from ROS parameter files, read as ROS's own parser (rcl) reads them, but without
ROS."""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Callable, Iterator
from pathlib import Path

from ..config import ConfigError, fields

NODE = 'fluoro_shape'
KEY = 'ros__parameters'
TRUE, FALSE = ({form(word) for word in words for form in (str.lower, str.title, str.upper)}
               for words in (('y', 'yes', 'true', 'on'), ('n', 'no', 'false', 'off')))
INTEGER = re.compile(r'[+-]?(0x[0-9a-f]+|0[0-7]*|[1-9][0-9]*)', re.ASCII | re.IGNORECASE)
REAL = re.compile(r'[+-]?(0x[0-9a-f]+\.?[0-9a-f]*(p[+-]?\d+)?|(\d+\.?\d*|\.\d+)(e[+-]?\d+)?|\.?inf|infinity|\.?nan)',
                  re.ASCII | re.IGNORECASE)
SECTION = re.compile(r'(/?(\w+|\*\*?))+', re.ASCII)
LARGEST = 2**63         # of whole numbers; a larger one is real
_FIELDS = {f.name: f for f in fields()}
# nothing that an offline tool could need
_OF_EVERY_NODE = ('use_sim_time', 'qos_overrides', 'start_type_description_service')


def read_parameters(path: str | None = None, assignments: list[str] | tuple[str, ...] = (),
                    say: Callable[[str], None] = lambda words: None) -> dict:
    """Parameter name to value, from a ROS parameter file and from 'name=value' texts (name:=value will do), which win.

    Names in the file that are no parameters, which may be other nodes', are left out; `say` gets a line about each.
    Raises ConfigError for what is no parameter or no value, and OSError where there is no such file. Ranges are for
    Config to check.
    """
    values = _read_file(path) if path else {}
    for name in [name for name in values if name not in _FIELDS]:
        del values[name]
        near = difflib.get_close_matches(name, _FIELDS, 1)
        say(f'{path}: there is no parameter {name}{f", but {near[0]}" if near else ""}')
    for text in assignments:
        name, equals, value = text.partition('=')
        if not equals:
            raise ConfigError(f'{text}: needs the form name=value')
        name = name.rstrip(':').strip()
        values[name] = _typed(name, _assigned(value, text))
    return {name: value for name, value in values.items() if value is not None}


def _read_file(path: str) -> dict:
    """The values for the node /fluoro_shape: of the sections that match it the one that begins later wins, whatever its
    name, as in rcl."""
    import yaml

    text = Path(path).read_text(errors='replace')
    try:
        aliases = any(isinstance(event, yaml.AliasEvent) for event in yaml.parse(text))
        documents = list(yaml.compose_all(text, yaml.SafeLoader))
    except yaml.YAMLError as error:
        raise ConfigError(f'{path}: not YAML ({" ".join(str(error).split())})') from error
    if aliases:
        raise ConfigError(f'{path}: ROS takes no aliases (*name)')
    if not documents or not all(isinstance(document, yaml.MappingNode) for document in documents):
        raise ConfigError(f'{path}: not a ROS parameter file')
    sections: dict[str, dict] = {}
    for document in documents:
        for name, given in _sections(document, path):
            sections.setdefault(name, {}).update(given)     # a name that comes again keeps its place
    own = [given for name, given in sections.items() if _matches(name)]
    if not own:
        found = f', but of {", ".join(sections)}' if sections else ''
        raise ConfigError(f'{path}: no {KEY} of {NODE} (nor of /**){found}')
    return {name: _typed(name, value) for given in own for name, value in given.items()
            if name.partition('.')[0] not in _OF_EVERY_NODE}


def _sections(node, path: str, prefix: str = '') -> Iterator[tuple[str, dict]]:
    """Name of a node, as it is written with its namespaces, and its values, for every section below a YAML mapping
    node."""
    closed = False
    for key, value in node.value:
        name, line = str(key.value), key.start_mark.line + 1
        if closed:
            raise ConfigError(f'{path}: {name} in line {line} stands beside {KEY}')
        if name.startswith(KEY):
            if not prefix or value.id != 'mapping':
                raise ConfigError(f'{path}: {KEY} in line {line} needs the name of a node before it and '
                                  'parameters below it')
            yield prefix, dict(_parameters(value, path))
            closed = True
        elif value.id != 'mapping':
            raise ConfigError(f'{path}: no {KEY} before line {line}')
        elif not SECTION.fullmatch(name.strip('/') or '_'):
            raise ConfigError(f'{path}: {name} in line {line} is no name of a node')
        else:
            yield from _sections(value, path, f'{prefix.rstrip("/")}/{name.lstrip("/")}' if prefix else name)


def _matches(name: str) -> bool:
    """Whether a section is one of the node /fluoro_shape: ** stands for any namespaces, * for one name."""
    pattern = f'/{name.lstrip("/")}'.replace('/**',
                                             r'(/\w+)+' if name.endswith('**') else r'(/\w+)*').replace('/*', r'/\w+')
    return re.fullmatch(pattern, f'/{NODE}') is not None


def _parameters(node, path: str, prefix: str = '') -> Iterator[tuple[str, object]]:
    """Name and value; names in nested mappings are joined by dots."""
    for key, value in node.value:
        name = f'{prefix}{key.value}'
        if value.id == 'mapping':
            yield from _parameters(value, path, f'{name}.')
        else:
            yield name, _value(value, f'{path}: {name} in line {key.start_mark.line + 1}')


def _value(node, what: str, mixed: bool = False):
    """A scalar or a list of scalars, which have one type unless `mixed`; None for an empty list, which says nothing to
    ROS."""
    if node.id == 'scalar':
        if not node.value and node.style is None:
            raise ConfigError(f'{what} has no value')
        return _scalar(node)
    if node.id != 'sequence' or any(element.id != 'scalar' for element in node.value):
        raise ConfigError(f'{what}: neither a value nor a list of values')
    values = [_value(element, what) for element in node.value]
    if not mixed and len(set(map(type, values))) > 1:
        raise ConfigError(f'{what}: the values of a list must be of one type, as in [0.0, 1.0]')
    return values or None


def _scalar(node):
    """What rcl takes a YAML scalar for: what is in quotes is text, and there are other words for numbers than YAML 1.1
    has."""
    text = node.value
    if node.style in ('"', "'"):
        return text
    if text in TRUE | FALSE:
        return text in TRUE
    if INTEGER.fullmatch(text):
        digits = text.lstrip('+-').lower()
        number = int(digits, 16 if digits.startswith('0x') else 8 if digits.startswith('0') else 10)
        if number < LARGEST:
            return -number if text.startswith('-') else number
    if not REAL.fullmatch(text):
        return text
    word = text.lower()
    value = float.fromhex(word) if 'x' in word else float(word.replace('.inf', 'inf').replace('.nan', 'nan'))
    return text if math.isinf(value) and 'inf' not in word else value     # too large for a double


def _assigned(value: str, text: str):
    """The value of a name=value text; lists of whole and real numbers will do. An empty list stays one."""
    import yaml

    try:
        node = yaml.compose(value, yaml.SafeLoader)
    except yaml.YAMLError as error:
        raise ConfigError(f'{text}: not YAML ({" ".join(str(error).split())})') from error
    if node is None:
        return ''
    found = _value(node, text, mixed=True)
    return [] if found is None else found


def _typed(name: str, value):
    """`value` as Config takes it: a list becomes a tuple."""
    return tuple(value) if name in _FIELDS and isinstance(value, list) else value
