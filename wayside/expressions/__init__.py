"""CEL for both programs: numbers are doubles, unknowns follow Kleene, and texts may hold `${…}`."""

from wayside.expressions.cel import RESERVED_WORDS, Environment, Expression, Kind, Value
from wayside.expressions.errors import EvaluationError, ExpressionError, InterpolationError
from wayside.expressions.interpolation import CompiledTemplate, Embedded, Json, compile_template
from wayside.expressions.projection import normalise
from wayside.expressions.syntax import Path
from wayside.expressions.unknown import UNKNOWN, Reason, Unknown

__all__ = [
    "RESERVED_WORDS",
    "UNKNOWN",
    "CompiledTemplate",
    "Embedded",
    "Environment",
    "EvaluationError",
    "Expression",
    "ExpressionError",
    "InterpolationError",
    "Json",
    "Kind",
    "Path",
    "Reason",
    "Unknown",
    "Value",
    "compile_template",
    "normalise",
]
