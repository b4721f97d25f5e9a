"""Parameters from the command line and from ROS parameter files, without ROS."""

from __future__ import annotations

from pathlib import Path

from ..config import ConfigError, fields

NODE = 'fluoro_shape'
_FIELDS = {f.name: f for f in fields()}
_OF_EVERY_NODE = ('use_sim_time', 'qos_overrides', 'start_type_description_service')    # nothing that an offline tool could need


def read_parameters(path: str | None = None, assignments: list[str] | tuple[str, ...] = ()) -> dict:
    """Parameter name to value, from a ROS parameter file and from 'name=value' texts (name:=value will do), which win.

    Raises ConfigError for what is no parameter or no value, and OSError where there is no such file. Ranges are for Config to check.
    """
    values = _read_file(path) if path else {}
    for text in assignments:
        name, equals, value = text.partition('=')
        if not equals:
            raise ConfigError(f'{text}: needs the form name=value')
        name = name.rstrip(':').strip()
        values[name] = _typed(name, _yaml(value, text))
    return values


def _read_file(path: str) -> dict:
    content = _yaml(Path(path).read_text(errors='replace'), path)
    if not isinstance(content, dict):
        raise ConfigError(f'{path}: not a ROS parameter file')
    values, found = {}, False
    for node in ('/**', '/*', NODE, f'/{NODE}'):    # the more particular ones win, as in ROS
        section = content.get(node)
        given = section.get('ros__parameters') if isinstance(section, dict) else None
        if isinstance(given, dict):
            found = True
            values |= {name: _typed(name, value) for name, value in given.items() if name not in _OF_EVERY_NODE}
    if not found:
        raise ConfigError(f'{path}: no ros__parameters of {NODE} (nor of /**)')
    return values


def _yaml(text: str, source: str):
    import yaml

    try:
        return yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise ConfigError(f'{source}: not YAML ({" ".join(str(error).split())})') from error


def _typed(name: str, value):
    """`value` as Config takes it: YAML 1.1 reads 1e-3 as text, ROS as a number; a list becomes a tuple."""
    f = _FIELDS.get(name)
    if f is None:
        return value
    if f.metadata['element'] is not None:
        return tuple(map(_number, value)) if isinstance(value, list) else (value,)
    return _number(value) if isinstance(f.default, float) else value


def _number(value):
    try:
        return float(value) if isinstance(value, str) else value
    except ValueError:
        return value
