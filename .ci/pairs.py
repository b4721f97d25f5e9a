"""For mypy: `tuple(f(plane) for plane in planes)` is a pair where a pair is wanted, if what is in it fits; mypy can't
know how long it is.

Where nothing says what is wanted, as in `seen = tuple(...)`, it may become a pair later, and what is in it is not
looked at.
"""

from collections.abc import Callable

from mypy.plugin import FunctionContext, Plugin
from mypy.subtypes import is_subtype
from mypy.types import AnyType, Instance, TupleType, Type, TypeOfAny, UnionType, get_proper_type


class Pairs(Plugin):
    def get_function_hook(self, fullname: str) -> Callable[[FunctionContext], Type] | None:
        return as_wanted if fullname == 'builtins.tuple' else None


def as_wanted(context: FunctionContext) -> Type:
    made = get_proper_type(context.default_return_type)
    if not isinstance(made, Instance):
        return made
    wanted = get_proper_type(context.api.type_context[-1]) if context.api.type_context else None
    kinds = [get_proper_type(kind) for kind in (wanted.items if isinstance(wanted, UnionType) else [wanted])]
    pairs = [kind for kind in kinds if isinstance(kind, TupleType)]
    if not pairs:
        return made.copy_modified(args=[AnyType(TypeOfAny.special_form)])
    return next((pair for pair in pairs if all(is_subtype(made.args[0], item) for item in pair.items)), made)


def plugin(version: str) -> type[Plugin]:
    return Pairs
