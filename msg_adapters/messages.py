"""Messages made without caring who made the library: rclpy's classes and the dataclasses of rosbags look alike.

A factory is a callable `new('nav_msgs/msg/Path', header=..., poses=[...])`. Fields that are not given have their
default; numeric sequences may be given as numpy arrays of any shape, `byte` fields as int. Reading needs no help: both
kinds have the same attributes.
"""

from __future__ import annotations

import array
import functools
import importlib
from collections.abc import Callable
from typing import Any

import numpy as np

New = Callable[..., Any]        # the type of a factory; a message is of any type that has its fields

_TYPECODES = {'uint8': 'B', 'octet': 'B', 'int8': 'b', 'uint16': 'H', 'int16': 'h', 'uint32': 'I', 'int32': 'i',
              'uint64': 'Q', 'int64': 'q',
              'float': 'f', 'double': 'd'}      # of array.array, by the element type's name in ROS interfaces


def ros_message(type_name: str, **fields: Any) -> Any:
    """A real ROS message of type 'package/msg/Name'; imports the class when first asked. Raises ImportError where ROS
    is not installed."""
    cls, kinds = _ros_class(type_name)
    return cls(**{key: _ros_value(kinds[key], value) for key, value in fields.items()})


@functools.cache
def _ros_class(type_name: str) -> tuple[Callable[..., Any], dict[str, str]]:
    """The class and the types of its fields by name; a Path asks for the same four hundreds of times."""
    package, _, name = type_name.split('/')
    cls = getattr(importlib.import_module(f'{package}.msg'), name)
    return cls, cls.get_fields_and_field_types()


def _ros_value(kind: str, value: Any) -> Any:
    """`value` as rclpy wants it for a field of type `kind`: it takes arrays at once that have the right type, and
    checks others one by one."""
    if kind == 'octet':
        return bytes([value])
    if not isinstance(value, np.ndarray):
        return value
    if kind.startswith('sequence<'):
        # frombytes is one memcpy; assigning bytes or a list costs ~50 times that
        out = array.array(_TYPECODES[kind[len('sequence<'):].split(',')[0].rstrip('>')])
        out.frombytes(np.ascontiguousarray(value, out.typecode).data.cast('B') if value.size else b'')
        return out
    return np.ascontiguousarray(value, _TYPECODES[kind.split('[')[0]]).ravel()


def bag_message(typestore: Any) -> New:
    """A factory of the messages that `typestore` (of rosbags) knows; these dataclasses need every field and numpy
    arrays."""

    @functools.cache
    def plan(type_name: str) -> tuple[Callable[..., Any], dict[str, Any], dict[str, np.dtype]]:
        """The class, its fields, and which of them are numeric sequences, of what type; a Path asks for the same four
        hundreds of times."""
        kinds = dict(typestore.fielddefs[type_name][1])
        numeric = {name: _dtype(detail[0][1][0]) for name, (node, detail) in kinds.items()
                   if node.name in ('ARRAY', 'SEQUENCE') and _is_numeric(detail[0])}
        return typestore.types[type_name], kinds, numeric

    def new(type_name: str, **fields: Any) -> Any:
        cls, kinds, numeric = plan(type_name)
        if fields.keys() != kinds.keys():
            unknown = fields.keys() - kinds.keys()
            if unknown:
                raise TypeError(f'{type_name} has no field {", ".join(sorted(unknown))}')
            fields = {name: fields[name] if name in fields else _bag_default(new, kind) for name, kind in kinds.items()}
        for name, dtype in numeric.items():
            fields[name] = np.ascontiguousarray(fields[name], dtype).ravel()
        return cls(**fields)

    return new


def _is_numeric(kind: Any) -> bool:
    """Whether sequences of this element type are numpy arrays in rosbags."""
    node, detail = kind
    return node.name == 'BASE' and detail[0] != 'string'


def _dtype(name: str) -> np.dtype:
    return np.dtype({'byte': 'uint8', 'octet': 'uint8', 'char': 'uint8'}.get(name, name))


def _bag_default(new: New, kind: Any) -> Any:
    node, detail = kind
    if node.name == 'NAME':
        return new(detail)
    if node.name == 'BASE':
        name = detail[0]
        return {'string': '', 'bool': False}.get(name, 0.0 if name.startswith('float') else 0)
    element, length = detail[0], detail[1] if node.name == 'ARRAY' else 0
    if _is_numeric(element):
        return np.zeros(length, _dtype(element[1][0]))
    return [_bag_default(new, element) for _ in range(length)]


def header(new: New, stamp_ns: int, frame_id: str) -> Any:
    """std_msgs/Header with a stamp in nanoseconds."""
    sec, nanosec = divmod(int(stamp_ns), 10**9)
    return new('std_msgs/msg/Header', stamp=new('builtin_interfaces/msg/Time', sec=sec, nanosec=nanosec),
               frame_id=frame_id)


def short(text: str, length: int = 40) -> str:
    """`text` for a message to people: a string from the network may have any length and any characters."""
    text = ''.join(c if c.isprintable() else '?' for c in text[:length + 1])
    return text if len(text) <= length else text[:length] + '...'


def stamp_ns(msg: Any) -> int:
    """The stamp of a message with a header, or of a header, in nanoseconds."""
    stamp = getattr(msg, 'header', msg).stamp
    return stamp.sec * 10**9 + stamp.nanosec
