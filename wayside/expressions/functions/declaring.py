"""The declaration of functions: parameters have names, so that errors can name them.

CEL selects the implementation by the types of the arguments. So a parameter for a list, a map or bytes has two CEL
types: the value itself for a literal (`[[0, 0], [4, 0]]`), and the handle for a value from the input.
"""

from __future__ import annotations

import dataclasses
import enum
import itertools
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

from cel_expr_python import cel

from wayside.expressions.functions.calls import Arguments, called_by_cel
from wayside.expressions.handles import value_of


class ArgumentType(enum.Enum):
    """The type of a parameter, as errors name it."""

    NUMBER = "number"
    TEXT = "string"
    BYTES = "bytes"
    LIST = "list"
    MAP = "map"


class ResultType(enum.Enum):
    """The type of a function's result."""

    NUMBER = "number"
    BOOLEAN = "boolean"
    TEXT = "string"
    LIST = "list"


_TAKES = {
    ArgumentType.NUMBER: (cel.Type.DOUBLE,),
    ArgumentType.TEXT: (cel.Type.STRING,),
    ArgumentType.BYTES: (cel.Type.BYTES, cel.Type.UINT),
    ArgumentType.LIST: (cel.Type.List(cel.Type.DYN), cel.Type.UINT),
    ArgumentType.MAP: (cel.Type.Map(cel.Type.STRING, cel.Type.DYN), cel.Type.UINT),
}
_UNREAD = frozenset({ArgumentType.BYTES, ArgumentType.LIST, ArgumentType.MAP})
_YIELDS = {
    ResultType.NUMBER: cel.Type.DOUBLE,
    ResultType.BOOLEAN: cel.Type.BOOL,
    ResultType.TEXT: cel.Type.STRING,
    ResultType.LIST: cel.Type.List(cel.Type.DYN),
}


@dataclass(frozen=True, slots=True)
class FunctionParameter:
    """A parameter. Its name contains the unit, unless the unit is clear from the meaning."""

    name: str
    type: ArgumentType


@dataclass(frozen=True, slots=True)
class Signature:
    """One way to call a function."""

    parameters: tuple[FunctionParameter, ...]
    implementation: Callable[..., object]


@dataclass(frozen=True, slots=True)
class Function:
    """A function of expressions."""

    name: str
    result: ResultType
    summary: str
    """The meaning of the result, with its unit."""
    signatures: tuple[Signature, ...]

    @property
    def takes_handles(self) -> bool:
        """Whether it takes a list, a map or bytes."""
        return any(p.type in _UNREAD for signature in self.signatures for p in signature.parameters)

    def usage(self) -> str:
        """The ways to call it, as in `inside(x, y, polygon)`."""
        return " or ".join(
            f"{self.name}({', '.join(p.name for p in signature.parameters)})" for signature in self.signatures
        )

    def types(self) -> str:
        """The parameters' types, as in `number, number, list`."""
        return " or ".join(", ".join(p.type.value for p in s.parameters) for s in self.signatures)

    def declaration(self) -> cel.FunctionDecl:
        """The declaration for CEL."""
        return cel.FunctionDecl(self.name, list(self._overloads()))

    def _overloads(self) -> Iterator[cel.Overload]:
        for number, signature in enumerate(self.signatures):
            call = _called(self, signature)
            for types in itertools.product(*(_TAKES[parameter.type] for parameter in signature.parameters)):
                identifier = "_".join((self.name, str(number), *(each.name().split("<")[0].lower() for each in types)))
                yield cel.Overload(identifier, _YIELDS[self.result], list(types), False, call)


def _called(function: Function, signature: Signature) -> Callable[..., object]:
    """The implementation, called with the values of handles. A NaN argument, which is unknown, raises ValueError."""

    def call(arguments: Arguments) -> object:
        values = [value_of(argument) for argument in arguments]
        for parameter, value in zip(signature.parameters, values, strict=True):
            if isinstance(value, float) and math.isnan(value):
                raise ValueError(f"no value for {parameter.name} of {function.name}: it is not a number")
            if parameter.type in _UNREAD and not _fits(parameter.type, value):
                article = "" if parameter.type is ArgumentType.BYTES else "a "
                raise ValueError(f"{function.name}: {parameter.name} must be {article}{parameter.type.value}")
        return signature.implementation(*values)

    return called_by_cel(call)


def _fits(wanted: ArgumentType, value: object) -> bool:
    if wanted is ArgumentType.BYTES:
        return isinstance(value, bytes | bytearray | memoryview)
    if wanted is ArgumentType.LIST:
        return isinstance(value, list | tuple) or hasattr(value, "tolist")  # a numpy array, which behaves like a list
    return isinstance(value, Mapping) or dataclasses.is_dataclass(value)


def function(name: str, result: ResultType, summary: str, *ways: tuple[Callable[..., object], str]) -> Function:
    """A function with its signatures: for each, an implementation, and the parameters as in `x y polygon:list`."""
    return Function(
        name,
        result,
        summary,
        tuple(
            Signature(tuple(map(_parameter, parameters.split())), implementation) for implementation, parameters in ways
        ),
    )


def _parameter(text: str) -> FunctionParameter:
    name, _, type_ = text.partition(":")
    return FunctionParameter(name, ArgumentType(type_) if type_ else ArgumentType.NUMBER)
