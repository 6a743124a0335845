"""Detects other managers of the same namespaces by the statuses of templates.

Managers with the same Lease take turns. Two releases have a Lease each, and neither may read the other's. So each
manager writes its Lease, and the Lease's creation time, into the status of every template. The one with the older Lease
is active in the namespace, and the other one waits. The waiting manager regularly tests whether the other one is alive:
it writes itself into one template, and a live manager overwrites that. docs/decisions/0028 has the reasons.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

from application_manager.core.objects.policy import Name
from wayside.api.applicationtemplate import TemplateManager

ANSWER = 5.0
"""Seconds in which a live manager responds to such a test."""

log = logging.getLogger(__name__)


class NamespaceRole(Enum):
    """What a manager may do in a namespace."""

    ACT = "act"
    WAIT = "wait"
    CHALLENGE = "write itself into the template's status, and nothing else"


@dataclass(slots=True)
class _Yielded:
    """A namespace in which this manager waits.

    Attributes:
        template: the one whose status is used for the test.
        until: the time of the next test or, during a test, the time at which the other manager counts as gone; in
            seconds since 1970.
    """

    rival: TemplateManager
    template: Name
    until: float
    tried: bool = False


class OverlapIndex:
    """The namespaces that other managers manage as well.

    Attributes:
        own: this manager, as it writes itself into statuses; None while its Lease is not known.
        every: seconds between two tests.
        resumed: called with a namespace in which this manager becomes active again.
    """

    def __init__(self) -> None:
        self.own: Callable[[], TemplateManager | None] = lambda: None
        self.every = 60.0
        self.resumed: Callable[[str], None] = lambda _: None
        self._written: dict[Name, str] = {}  # the Lease in a template's status
        self._yielded: dict[str, _Yielded] = {}
        self._younger: set[tuple[str, str]] = set()  # namespaces and Leases that were logged

    def yields(self, namespace: str) -> bool:
        """Whether this manager waits in the namespace."""
        return namespace in self._yielded

    @property
    def count(self) -> int:
        """The number of namespaces in which it waits."""
        return len(self._yielded)

    def note(self, template: Name, written: TemplateManager | None, now: float) -> None:
        """Note the manager in a template's status; `now` is in seconds since 1970."""
        own, namespace = self.own(), template[0]
        if own is None or written is None:
            return
        before = self._written.get(template)
        self._written[template] = written.lease
        if written.lease == own.lease:
            return
        if (own.since, own.lease) < (written.since, written.lease):
            self._report_younger(namespace, written)
        elif before == own.lease:  # it has responded, or is back
            self._yield(_Yielded(written, template, now + self.every))
        elif namespace not in self._yielded:  # it may be gone
            self._yield(_Yielded(written, template, now))

    def role(self, template: Name, now: float) -> tuple[NamespaceRole, float]:
        """The role of this manager for a template at `now`, and when that changes, both in seconds since 1970."""
        state = self._yielded.get(template[0])
        if state is None:
            return NamespaceRole.ACT, now
        if state.template != template or now < state.until:
            return NamespaceRole.WAIT, max(state.until, now + 1.0)
        return (NamespaceRole.ACT, now) if state.tried else (NamespaceRole.CHALLENGE, now + ANSWER)

    def take(self, namespace: str, role: NamespaceRole, until: float) -> None:
        """Note that the manager takes this role in the namespace; `until` as above."""
        state = self._yielded.get(namespace)
        if state is not None and role is NamespaceRole.CHALLENGE:
            state.tried, state.until = True, until
        elif state is not None and role is NamespaceRole.ACT:
            self._resume(namespace, f"the manager of the Lease {state.rival.lease} does not respond")

    def waits_for(self, namespace: str) -> str:
        """The Lease of the manager that is active in the namespace instead of this one; empty if none is."""
        state = self._yielded.get(namespace)
        return state.rival.lease if state is not None else ""

    def forget(self, template: Name) -> None:
        """Note that a template was deleted."""
        self._written.pop(template, None)
        state = self._yielded.get(template[0])
        if state is not None and state.template == template:
            self._resume(template[0], f"template {template[1]} was deleted")

    def _yield(self, state: _Yielded) -> None:
        namespace = state.template[0]
        if namespace not in self._yielded:
            log.warning(
                "namespace %s is also managed by the manager of the Lease %s, which is older: this manager stands "
                "by there. Give each manager its own namespaces, or both the same Lease",
                namespace,
                state.rival.lease,
            )
        self._yielded[namespace] = state

    def _resume(self, namespace: str, why: str) -> None:
        del self._yielded[namespace]
        log.warning("namespace %s: this manager becomes active there: %s", namespace, why)
        self.resumed(namespace)

    def _report_younger(self, namespace: str, rival: TemplateManager) -> None:
        if (namespace, rival.lease) not in self._younger:
            self._younger.add((namespace, rival.lease))
            log.warning(
                "namespace %s is also managed by the manager of the Lease %s, which is younger and should stand "
                "by. Give each manager its own namespaces, or both the same Lease",
                namespace,
                rival.lease,
            )
