"""The store of the cache: the newest version of each object that the manager has received.

Watch events, responses to our own writes and lists update it, in any order. An older version never replaces a newer
one, and a list that is older than a deletion does not restore the deleted object.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator, Set
from dataclasses import dataclass
from typing import TypeVar

from application_manager.core.claims.parameters import size_problem
from application_manager.core.objects import trimming
from application_manager.core.objects.ownership import FIELD_MANAGER
from application_manager.core.objects.policy import KindKey, Name
from wayside.api import ApplicationTask
from wayside.api.base import Kind
from wayside.api.documents import parse_object
from wayside.kubernetes.resources import Object

Group = TypeVar("Group")
Member = TypeVar("Member")
Value = TypeVar("Value")

_TOMBSTONES = 10_000  # uids of deleted objects to remember; the oldest are forgotten


@dataclass(frozen=True, slots=True)
class Entry:
    """An object without the fields that nothing reads (see `trimming`): raw, and for our own kinds as a model.

    `problem`: why there is no model, or why a part of it is missing: the part is too large.
    """

    raw: Object
    model: Kind | None = None
    problem: str = ""

    @property
    def uid(self) -> str:
        """The object's uid."""
        return str(self.raw["metadata"]["uid"])

    @property
    def version(self) -> int:
        """The object's resourceVersion, which increases."""
        return int(self.raw["metadata"]["resourceVersion"])


class MembersByGroup(dict[Group, dict[Member, Value]]):
    """The values of members, by group; groups without members do not exist."""

    def put(self, group: Group, member: Member, value: Value) -> None:
        """Note the value of a member."""
        self.setdefault(group, {})[member] = value

    def drop(self, group: Group, member: Member) -> None:
        """Forget a member, if it exists."""
        members = self.get(group, {})
        members.pop(member, None)
        if not members:
            self.pop(group, None)


class Store:
    """Objects by kind, then by namespace and name. `shed`: the uids of tasks that were left out for lack of memory."""

    def __init__(self, modelled: Iterable[KindKey], full: Callable[[], bool] = lambda: False) -> None:
        """Create an empty store, with models of the kinds `modelled`.

        `full`: whether memory is short, so that no new tasks are accepted; tasks that were served before always are.
        """
        self._modelled = frozenset(modelled)
        self._full = full
        self.shed: dict[Name, str] = {}
        self._objects: dict[KindKey, dict[Name, Entry]] = {}
        self._deleted: OrderedDict[str, None] = OrderedDict()

    def get(self, kind: KindKey, name: Name) -> Entry | None:
        """The object, or None."""
        return self._objects.get(kind, {}).get(name)

    def all(self, kind: KindKey) -> Iterator[tuple[Name, Entry]]:
        """All current objects of the kind."""
        yield from list(self._objects.get(kind, {}).items())

    def put(self, raw: Object) -> Entry | None:
        """Note an object; returns the new entry, or None if this version is already known."""
        kind, name = kind_of(raw), name_of(raw)
        uid = raw["metadata"]["uid"]
        known = self.get(kind, name)
        version = int(raw["metadata"]["resourceVersion"])
        if uid in self._deleted or (known is not None and known.version >= version):
            return None
        if known is None and kind[1] == ApplicationTask.__name__:
            if not _was_served(raw) and self._full():
                self.shed[name] = uid
                return None
            self.shed.pop(name, None)
        entry = self._entry(kind, raw)
        self._objects.setdefault(kind, {})[name] = entry
        return entry

    def remove(self, raw: Object) -> Entry | None:
        """Note that an object was deleted; returns its entry, or None if the deletion is already known."""
        uid = raw["metadata"]["uid"]
        self._deleted[uid] = None
        if len(self._deleted) > _TOMBSTONES:
            self._deleted.popitem(last=False)
        if self.shed.get(name_of(raw)) == uid:
            del self.shed[name_of(raw)]
        known = self.get(kind_of(raw), name_of(raw))
        if known is None or known.uid != uid:
            return None
        return self._objects[kind_of(raw)].pop(name_of(raw))

    def missing(self, kind: KindKey, present: Set[Name], version: str, scope: str | None) -> list[Entry]:
        """The entries that are missing in a list (of the namespace `scope`, None for all)."""
        return [
            entry
            for name, entry in self.all(kind)
            if name not in present and entry.version <= int(version) and (scope is None or name[0] == scope)
        ]

    def _entry(self, kind: KindKey, raw: Object) -> Entry:
        if kind not in self._modelled:
            return Entry(trimming.others(raw, FIELD_MANAGER))
        lean = trimming.own(raw)
        try:
            model = parse_object(lean)
        except ValueError as error:  # too large, or older than its CRD: its status gives the reason
            return Entry({**lean, "spec": {}}, problem=str(error))
        problem = ""
        if isinstance(model, ApplicationTask):
            problem = size_problem(model.spec.parameters, "spec.parameters")
            if problem:
                model = model.model_copy(update={"spec": model.spec.model_copy(update={"parameters": {}})})
        return Entry(trimming.beside_model(lean), model, problem)


def _was_served(raw: Object) -> bool:
    """Whether the task has, or had, an instance: without the task, the instance would be released."""
    return bool((raw.get("status") or {}).get("instanceName"))


def kind_of(raw: Object) -> KindKey:
    """The kind of a raw object."""
    return raw["apiVersion"], raw["kind"]


def name_of(raw: Object) -> Name:
    """The namespace and name of a raw object."""
    return raw["metadata"]["namespace"], raw["metadata"]["name"]
