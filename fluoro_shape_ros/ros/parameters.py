"""The parameters of config.py as ROS parameters: declared once, checked by Config alone."""

from __future__ import annotations

import array
import dataclasses
import difflib

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import QoSDurabilityPolicy, QoSHistoryPolicy, QoSReliabilityPolicy

from ..config import Config, ConfigError, constraint, fields

_TYPES = {bool: Parameter.Type.BOOL, int: Parameter.Type.INTEGER, float: Parameter.Type.DOUBLE,
          str: Parameter.Type.STRING}
_FIELDS = {f.name: f for f in fields()}
_QOS = {'history': QoSHistoryPolicy, 'reliability': QoSReliabilityPolicy, 'durability': QoSDurabilityPolicy}
MAX_DEPTH = 10000       # of a queue; the middleware makes room for some of it at once


def declare(node: Node) -> Config:
    """Declare every parameter on `node` and return the Config of their values, overrides included.

    Whole numbers are taken for real ones. Raises ConfigError for an override that can't work, of a QoS policy too.
    """
    _check_qos(node)
    # Statically typed declarations refuse `robot_radius:=1` and can't express an empty list, so: take what is
    # there, check and convert it, and only then fix type and range.
    given = {name: node.declare_parameter(name, None, ParameterDescriptor(dynamic_typing=True)).value
             for name in _FIELDS}
    config = Config.from_values(**{name: _plain(value) for name, value in given.items() if value is not None})
    for name, value in config.values().items():
        node.set_parameters([_parameter(_FIELDS[name], value)])
        node.set_descriptor(name, descriptor(_FIELDS[name]))
    return config


def unknown(node: Node) -> str:
    """The values given at the start to what is no parameter of `node`, each with the parameter that may be meant, in
    words; empty where there are none."""
    known = list(node.get_parameters_by_prefix(''))
    words = []
    for name in _overrides(node):
        if not node.has_parameter(name):
            near = difflib.get_close_matches(name, known, 1)
            words.append(f'there is no parameter {name}{f", but {near[0]}" if near else ""}')
    return '; '.join(words)


def _check_qos(node: Node) -> None:
    """Raise ConfigError for a QoS override that rclpy would fail at without naming it."""
    for name, value in _overrides(node).items():
        first, policy = name.partition('.')[0], name.rpartition('.')[2]
        if first != 'qos_overrides':
            continue
        if policy in _QOS:
            choices = ([c for c in _QOS[policy].short_keys() if c != 'unknown']
                       + ['auto'] * (policy == 'reliability' and '.subscription.' in name))
            if value not in choices:
                raise ConfigError(f'{name}: must be one of {", ".join(choices)}, got {value!r}')
        elif policy == 'depth' and (type(value) is not int or not 0 <= value <= MAX_DEPTH):
            raise ConfigError(f'{name}: needs a whole number from 0 to {MAX_DEPTH}, got {value!r}')


def _overrides(node: Node) -> dict:
    """Name to value of what was given at the start, declared or not; rclpy tells it nowhere else."""
    return {name: p.value for name, p in node._parameter_overrides.items()}


def descriptor(f: dataclasses.Field) -> ParameterDescriptor:
    """What ROS tools can know of a parameter: type, description with unit, range, constraints."""
    m = f.metadata
    unit = f' ({m["unit"]})' if m['unit'] else ''
    d = ParameterDescriptor(name=f.name, type=_type(f).value, description=m['description'] + unit,
                            additional_constraints=constraint(f))
    if m['low'] is not None and _type(f) is Parameter.Type.DOUBLE:
        d.floating_point_range = [FloatingPointRange(from_value=m['low'], to_value=m['high'])]
    if m['low'] is not None and _type(f) is Parameter.Type.INTEGER:
        d.integer_range = [IntegerRange(from_value=m['low'], to_value=m['high'])]
    return d


def changed(config: Config, parameters: list[Parameter]) -> Config:
    """`config` with the values of `parameters` (those it knows); raises ConfigError."""
    return config.replace(**{p.name: _plain(p.value) for p in parameters if p.name in _FIELDS})


def as_declared(parameters: list[Parameter]) -> list[Parameter]:
    """The same parameters, with whole numbers as real ones and an empty list as an empty one of numbers where that is
    the declared type."""
    return [_parameter(_FIELDS[p.name], _plain(p.value)) if p.name in _FIELDS and _convertible(_FIELDS[p.name], p)
            else p for p in parameters]


def _type(f: dataclasses.Field) -> Parameter.Type:
    return Parameter.Type.DOUBLE_ARRAY if f.metadata['element'] else _TYPES[type(f.default)]


def _convertible(f: dataclasses.Field, p: Parameter) -> bool:
    if _type(f) is Parameter.Type.DOUBLE_ARRAY:     # tools send an empty list as one of bools or bytes
        return p.type_ is Parameter.Type.INTEGER_ARRAY or _plain(p.value) == ()
    return _type(f) is Parameter.Type.DOUBLE and p.type_ is Parameter.Type.INTEGER


def _parameter(f: dataclasses.Field, value) -> Parameter:
    """A ROS parameter of the declared type."""
    if _type(f) is Parameter.Type.DOUBLE_ARRAY:
        value = [float(v) for v in value]
    elif _type(f) is Parameter.Type.DOUBLE:
        value = float(value)
    return Parameter(f.name, _type(f), value)


def _plain(value):
    """A parameter value as Config takes it: lists as tuples."""
    return tuple(value) if isinstance(value, (list, tuple, array.array)) else value
