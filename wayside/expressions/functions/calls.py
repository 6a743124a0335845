"""Calls from CEL into Python, and the references that they lose.

cel-expr-python 0.1.3 keeps a reference to the arguments' tuple of every call, and one to every result: some 130 bytes
a call that nothing would ever free, which is gigabytes a day for a fleet. So the tuple and the result are noted while
the expression is evaluated, and that reference is dropped once the evaluation is over and CEL holds nothing any more.
Whether they are lost at all is tried when this is imported; a version that loses nothing is left alone.

Python makes a new tuple of a function's arguments. The one that CEL made is seen only by a C function: CPython's own
`PyObject_CallOneArg(function, argument)` has the signature of one, and gives the tuple to the function as it is.
"""

from __future__ import annotations

import ctypes
import sys
import threading
from collections.abc import Callable
from typing import Final, cast

from cel_expr_python import cel

Arguments = tuple[object, ...]

_METH_VARARGS = 1

_KEPT = 3
"""References to an object that is not lost, as `sys.getrefcount` counts them: the note, a variable, its argument."""


class _Method(ctypes.Structure):
    """CPython's PyMethodDef."""

    _fields_ = (
        ("name", ctypes.c_char_p),
        ("call", ctypes.c_void_p),
        ("flags", ctypes.c_int),
        ("documentation", ctypes.c_char_p),
    )


class _Noted(threading.local):
    """The arguments and results of the calls on this thread since `drop_lost_references`."""

    def __init__(self) -> None:
        self.arguments: list[Arguments] = []
        self.results: list[object] = []


_METHOD: Final = _Method(b"call", ctypes.cast(ctypes.pythonapi.PyObject_CallOneArg, ctypes.c_void_p), _METH_VARARGS)
_new_function = ctypes.pythonapi.PyCFunction_NewEx
_new_function.argtypes, _new_function.restype = [ctypes.c_void_p, ctypes.py_object, ctypes.c_void_p], ctypes.py_object
_drop_reference = ctypes.pythonapi.Py_DecRef
_drop_reference.argtypes, _drop_reference.restype = [ctypes.py_object], None

_noted = _Noted()


def called_by_cel(function: Callable[[Arguments], object]) -> Callable[..., object]:
    """A wrapper that CEL can call with arguments, for a function that takes them as one tuple."""

    def call(arguments: Arguments) -> object:
        _noted.arguments.append(arguments)
        result = function(arguments)
        if type(result) in _lost_results:
            _noted.results.append(result)
        return result

    return cast("Callable[..., object]", _new_function(ctypes.addressof(_METHOD), call, None))


def drop_lost_references() -> None:
    """The outermost evaluation on this thread is over, and its outcome gone: drop the references that CEL lost."""
    noted = _noted
    if not noted.arguments:
        return
    # Asking each for its references as well: what was not lost after all must never be freed under somebody's feet.
    if _arguments_are_lost:
        for arguments in noted.arguments:
            if sys.getrefcount(arguments) > _KEPT:
                _drop_reference(arguments)
    for result in noted.results:
        if sys.getrefcount(result) > _KEPT:
            _drop_reference(result)
    noted.arguments.clear()
    noted.results.clear()


def _lost(implementation: Callable[[Arguments], object], yields: cel.Type) -> tuple[bool, bool]:
    """Whether a call loses its arguments, and its result."""
    seen: list[object] = []

    def call(arguments: Arguments) -> object:
        seen.append(arguments)
        result = implementation(arguments)
        seen.append(result)
        return result

    function = _new_function(ctypes.addressof(_METHOD), call, None)
    overload = cel.Overload("probe_double", yields, [cel.Type.DOUBLE], False, function)
    environment = cel.NewEnv(
        variables={"x": cel.Type.DOUBLE}, functions=[cel.FunctionDecl("probe", [overload])]
    )  # fmt: skip
    program = environment.compile("probe(x)")
    outcome = program.eval(data={"x": 1.5})
    outcome.plain_value()
    del outcome
    counts = []
    for each in seen:
        counts.append(sys.getrefcount(each) > _KEPT)
    return counts[0], counts[1]


_PROBES: Final[tuple[tuple[type, cel.Type, Callable[[Arguments], object]], ...]] = (
    (float, cel.Type.DOUBLE, lambda arguments: cast("float", arguments[0]) + 0.25),
    (int, cel.Type.INT, lambda arguments: int(cast("float", arguments[0])) + 2**40),
    (str, cel.Type.STRING, lambda arguments: f"probe {arguments[0]}"),
    (list, cel.Type.List(cel.Type.DYN), lambda arguments: [f"probe {arguments[0]}"]),
)
_found: Final = {kind: _lost(implementation, yields) for kind, yields, implementation in _PROBES}
_arguments_are_lost: Final = all(arguments for arguments, _ in _found.values())
_lost_results: Final = frozenset(kind for kind, (_, result) in _found.items() if result)
