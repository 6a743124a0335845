"""Which loops become folds, and that nothing else does."""

from __future__ import annotations

import pytest

from wayside.expressions import CelType, Environment
from wayside.expressions.columns.folds import FoldKind, folded
from wayside.expressions.syntax import Loop

ENVIRONMENT = Environment({"members": CelType.LIST, "others": CelType.LIST, "limit": CelType.DOUBLE})


def loops(node: object) -> int:
    """How many loops there are in a tree."""
    if isinstance(node, tuple):
        return sum(loops(each) for each in node)
    fields = [getattr(node, name) for name in getattr(node, "__match_args__", ())]
    return isinstance(node, Loop) + sum(loops(each) for each in fields)


@pytest.mark.parametrize(
    ("source", "how"),
    [
        ("members.exists(m, m.v > limit)", [FoldKind.ANY]),
        ("members.all(m, m.v > limit)", [FoldKind.ALL]),
        ("members.exists_one(m, m.v > limit)", [FoldKind.COUNT]),
        ("size(members) > 2", [FoldKind.COUNT]),
        ("members.size() > 2", [FoldKind.COUNT]),
        ("size(members.filter(m, m.v > 1)) >= 2", [FoldKind.COUNT]),
        ("!(members.filter(m, m.v > 1).size() * 2 >= size(members)) || members.all(m, m.v > 0)",
         [FoldKind.COUNT, FoldKind.COUNT, FoldKind.ALL]),
    ],
)  # fmt: skip
def test_loops_over_the_items_become_folds(source: str, how: list[FoldKind]) -> None:
    rest, folds = folded(ENVIRONMENT.compile(source, result=CelType.BOOL), "members")
    assert [each.kind for each in folds.values()] == how
    assert loops(rest.tree) == 0


@pytest.mark.parametrize(
    ("source", "left"),
    [
        ("others.exists(m, m.v > 1)", 1),
        ("members.map(m, m.v)[0] > 1.0", 1),
        ("members.filter(m, m.v > 1).exists(m, m.w > 1)", 2),
    ],
)
def test_other_loops_stay(source: str, left: int) -> None:
    rest, folds = folded(ENVIRONMENT.compile(source, result=CelType.BOOL), "members")
    assert folds == {}
    assert loops(rest.tree) == left


def test_the_name_of_a_fold_differs_from_declared_variables() -> None:
    environment = Environment({"members": CelType.LIST, "fold0": CelType.DOUBLE})
    rest, folds = folded(environment.compile("size(members) > fold0", result=CelType.BOOL), "members")
    assert list(folds) == ["fold0_"]
    assert rest.names == {"members", "fold0", "fold0_"}
