"""For mypy: `tuple(f(plane) for plane in planes)` is a pair where a pair is wanted; its length is all that is taken on trust."""

from mypy.plugin import FunctionContext, Plugin
from mypy.subtypes import is_subtype
from mypy.types import AnyType, Instance, TupleType, Type, TypeOfAny, UnionType, get_proper_type


class Pairs(Plugin):
    def get_function_hook(self, fullname: str):
        return as_wanted if fullname == 'builtins.tuple' else None


def as_wanted(context: FunctionContext) -> Type:
    made = get_proper_type(context.default_return_type)
    wanted = get_proper_type(context.api.type_context[-1]) if context.api.type_context else None
    for kind in wanted.items if isinstance(wanted, UnionType) else [wanted]:
        kind = get_proper_type(kind)
        if isinstance(kind, TupleType) and isinstance(made, Instance) and all(is_subtype(made.args[0], item) for item in kind.items):
            return kind
    return made.copy_modified(args=[AnyType(TypeOfAny.special_form)]) if isinstance(made, Instance) else made


def plugin(version: str):
    return Pairs
