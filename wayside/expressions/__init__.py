"""CEL for both programs: numbers are doubles, unknown values follow Kleene's logic, and strings may contain `${…}`."""

from wayside.expressions.cel import RESERVED_WORDS, CelType, Environment, Expression, Value
from wayside.expressions.errors import EvaluationError, ExpressionError, InterpolationError
from wayside.expressions.interpolation import CompiledTemplate, Embedded, Json, compile_template
from wayside.expressions.projection import normalise
from wayside.expressions.syntax import Path
from wayside.expressions.unknown import UNKNOWN, Reason, Unknown

__all__ = [
    "RESERVED_WORDS",
    "UNKNOWN",
    "CelType",
    "CompiledTemplate",
    "Embedded",
    "Environment",
    "EvaluationError",
    "Expression",
    "ExpressionError",
    "InterpolationError",
    "Json",
    "Path",
    "Reason",
    "Unknown",
    "Value",
    "compile_template",
    "normalise",
]
