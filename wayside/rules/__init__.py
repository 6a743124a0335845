"""Rules, compiled against a Detector: the manager reports the problems, the engine evaluates the result."""

from wayside.rules.compiled import (
    ClientSubject,
    CompiledAction,
    CompiledDeploy,
    CompiledDerived,
    CompiledElement,
    CompiledModel,
    CompiledPlugin,
    CompiledPosition,
    CompiledRule,
    CompiledSignal,
    CompiledStream,
    CompiledWindow,
    FleetSubject,
    PairSubject,
    episode_stream,
)
from wayside.rules.compiling import compile_rule, own_problems
from wayside.rules.dependencies import dependency_problems, depends, in_order
from wayside.rules.fields import BYTES, Fields, ItemFields
from wayside.rules.parameters import unknown_rules
from wayside.rules.places import KnownPlaces, place_problems, places_of, shape_problems
from wayside.rules.problems import RuleError, RuleProblem
from wayside.rules.streams import compile_stream, source_problems, stream_problems

__all__ = [
    "BYTES",
    "ClientSubject",
    "CompiledAction",
    "CompiledDeploy",
    "CompiledDerived",
    "CompiledElement",
    "CompiledModel",
    "CompiledPlugin",
    "CompiledPosition",
    "CompiledRule",
    "CompiledSignal",
    "CompiledStream",
    "CompiledWindow",
    "Fields",
    "FleetSubject",
    "ItemFields",
    "KnownPlaces",
    "PairSubject",
    "RuleError",
    "RuleProblem",
    "compile_rule",
    "compile_stream",
    "dependency_problems",
    "depends",
    "episode_stream",
    "in_order",
    "own_problems",
    "place_problems",
    "places_of",
    "shape_problems",
    "source_problems",
    "stream_problems",
    "unknown_rules",
]
