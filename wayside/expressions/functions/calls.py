"""Calls from CEL into Python, and the references that these calls leak.

cel-expr-python 0.1.3 leaks a reference to the argument tuple of every call, and one to every result: about 130 bytes
per call, which is gigabytes per day for a fleet. So the tuple and the result are noted during the evaluation of the
expression, and the leaked references are dropped after it, when CEL has no reference any more. A test at import
determines whether the installed version leaks references; otherwise nothing is dropped.

Python creates a new tuple for the arguments of a Python function. Only a C function receives the tuple that CEL
created: CPython's `PyObject_CallOneArg(function, argument)` has the signature of such a function, and passes the tuple
on unchanged.
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
"""The `sys.getrefcount` of an object without a leak: the note, a variable, and the argument of the function."""


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
    """Drop the references that CEL leaked.

    To be called after the outermost evaluation on this thread, when its outcome is deleted.
    """
    noted = _noted
    if not noted.arguments:
        return
    # Each count is checked as well: an object that was not leaked must never be freed while it is in use.
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
    """Whether a call leaks its arguments, and its result."""
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
