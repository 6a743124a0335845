"""Rules, checked and compiled against a Detector: the manager reports what is wrong, the engine runs what is right."""

from wayside.rules.compiled import (
    ClientSubject,
    CompiledDeploy,
    CompiledElement,
    CompiledModel,
    CompiledPosition,
    CompiledRule,
    CompiledSignal,
    CompiledStream,
    FleetSubject,
    PairSubject,
)
from wayside.rules.compiling import RuleError, RuleProblem, compile_rule, compile_stream, stream_problems
from wayside.rules.fields import Fields
from wayside.rules.parameters import unknown_rules
from wayside.rules.sources import source_problems

__all__ = [
    "ClientSubject",
    "CompiledDeploy",
    "CompiledElement",
    "CompiledModel",
    "CompiledPosition",
    "CompiledRule",
    "CompiledSignal",
    "CompiledStream",
    "Fields",
    "FleetSubject",
    "PairSubject",
    "RuleError",
    "RuleProblem",
    "compile_rule",
    "compile_stream",
    "source_problems",
    "stream_problems",
    "unknown_rules",
]
