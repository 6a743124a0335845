"""Rules by the dimensions and values of the scheme. Other modules render them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path, PurePath

from wayside.api import EventRule
from wayside.api.classification import SCHEME, CharacteristicValue, Classification, Dimension
from wayside.api.documents import load_documents

Chosen = Mapping[Dimension, frozenset[CharacteristicValue]]
"""For some dimensions, the values of which a rule must have at least one."""


class ChoiceError(ValueError):
    """A dimension or value that is not in the scheme."""


@dataclass(frozen=True, eq=False)
class CatalogEntry:
    """A rule in the catalog; entries are distinct even if their contents are equal."""

    name: str
    place: str
    """Where it was found: file and line, or namespace."""
    description: str
    classification: Classification
    """Without values if the rule has none."""

    @property
    def classified(self) -> bool:
        """Whether the rule has a value in any dimension."""
        return bool(self.classification.to_json())

    def values(self, dimension: Dimension) -> tuple[CharacteristicValue, ...]:
        """Its values in the dimension, in the scheme's order."""
        given = self.classification.values_of(dimension)
        return tuple(value for value in dimension.values if value in given)


def entry(rule: EventRule, place: str) -> CatalogEntry:
    """The catalog entry of the rule."""
    return CatalogEntry(rule.name, place, rule.spec.description, rule.spec.classification or Classification())


@dataclass(frozen=True)
class Catalog:
    """Rules, by name and place."""

    entries: tuple[CatalogEntry, ...]

    def having(self, value: CharacteristicValue) -> tuple[CatalogEntry, ...]:
        """The rules that have the value; equally written values of two dimensions differ."""
        dimension = next(each for each in SCHEME if isinstance(value, each.values))
        return tuple(each for each in self.entries if value in each.values(dimension))

    def silent(self, dimension: Dimension) -> tuple[CatalogEntry, ...]:
        """The classified rules without a value in the dimension."""
        return tuple(each for each in self.entries if each.classified and not each.values(dimension))

    @property
    def unclassified(self) -> tuple[CatalogEntry, ...]:
        """The rules without any classification."""
        return tuple(each for each in self.entries if not each.classified)

    def labels(self) -> Mapping[CatalogEntry, str]:
        """The labels of the rules: the name, and the folder or file if several have the same name."""
        return dict(_labelled(self.entries))


@dataclass(frozen=True)
class Read:
    """Rules, and errors about those that could not be read."""

    entries: tuple[CatalogEntry, ...]
    unreadable: tuple[str, ...] = ()


def catalog(entries: Iterable[CatalogEntry], chosen: Chosen | None = None) -> Catalog:
    """The rules that have, in each chosen dimension, one of the chosen values."""
    wanted = (chosen or {}).items()
    kept = (each for each in entries if all(values & set(each.values(dimension)) for dimension, values in wanted))
    return Catalog(tuple(sorted(kept, key=lambda each: (each.name, each.place))))


def choose(texts: Iterable[str]) -> Chosen:
    """The choice given as `dimension=value`; several values of a dimension are alternatives.

    Raises:
        ChoiceError: the dimension or value does not exist; the message lists the valid ones.
    """
    chosen: dict[Dimension, frozenset[CharacteristicValue]] = {}
    for text in texts:
        name, _, written = text.partition("=")
        dimension = next((each for each in SCHEME if each.name == name), None)
        if dimension is None:
            raise ChoiceError(
                f"{text}: unknown dimension {name!r}; the dimensions are {_listed(each.name for each in SCHEME)}"
            )
        value = next((each for each in dimension.values if each.value == written), None)
        if value is None:
            there = _listed(each.value for each in dimension.values)
            raise ChoiceError(f"{text}: {name} has no value {written!r}; its values are {there}")
        chosen[dimension] = chosen.get(dimension, frozenset()) | {value}
    return chosen


def _listed(names: Iterable[str]) -> str:
    return ", ".join(names)


def _labelled(entries: Iterable[CatalogEntry]) -> Iterator[tuple[CatalogEntry, str]]:
    """By name; if several share one, with their place, without the common beginning of these places."""
    for name, group in groupby(entries, key=lambda each: each.name):
        same = list(group)
        if len(same) == 1:
            yield same[0], name
            continue
        paths = [PurePath(each.place).parts for each in same]
        common = next((i for i, parts in enumerate(zip(*paths, strict=False)) if len(set(parts)) > 1), 0)
        yield from ((each, f"{name} ({'/'.join(parts[common:])})") for each, parts in zip(same, paths, strict=True))


def read_files(paths: Sequence[Path]) -> Read:
    """The EventRules of the files and folders; other objects are ignored.

    Raises:
        DocumentError: with every problem of every file.
    """
    return Read(
        tuple(
            entry(document.object, f"{document.file}:{document.line}")
            for document in load_documents(paths)
            if isinstance(document.object, EventRule)
        )
    )
