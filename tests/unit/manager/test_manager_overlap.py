"""Two managers of a namespace: the younger one waits, and takes over only when the older one does not respond."""

from __future__ import annotations

from application_manager.cache.overlap_index import ANSWER, NamespaceRole, OverlapIndex
from wayside.api.applicationtemplate import TemplateManager

TIMES = "2026-01-01T00:00:00Z", "2026-01-02T00:00:00Z"
OLD, YOUNG = (
    TemplateManager(lease=f"a/{name}", since=since) for name, since in (("old", TIMES[0]), ("young", TIMES[1]))
)
TEMPLATE = ("site", "app")


def test_a_manager_waits_for_an_older_one_and_takes_over_where_it_does_not_respond() -> None:
    index, resumed = OverlapIndex(), list[str]()
    index.own, index.resumed = lambda: YOUNG, resumed.append
    assert index.role(TEMPLATE, 0.0) == (NamespaceRole.ACT, 0.0)
    index.note(TEMPLATE, OLD, 0.0)
    assert index.yields("site")
    assert index.role(("site", "another"), 0.0)[0] is NamespaceRole.WAIT
    for _ in range(2):  # to look changes nothing
        assert index.role(TEMPLATE, 0.0) == (NamespaceRole.CHALLENGE, ANSWER)
    index.take("site", NamespaceRole.CHALLENGE, ANSWER)
    assert index.role(TEMPLATE, ANSWER - 2) == (NamespaceRole.WAIT, ANSWER)
    for _ in range(2):
        assert index.role(TEMPLATE, ANSWER) == (NamespaceRole.ACT, ANSWER)
    assert (index.yields("site"), resumed) == (True, [])
    index.take("site", NamespaceRole.ACT, ANSWER)
    assert (index.yields("site"), resumed) == (False, ["site"])


def test_an_older_manager_that_responds_stays_active() -> None:
    index = OverlapIndex()
    index.own = lambda: YOUNG
    index.note(TEMPLATE, OLD, 0.0)
    index.take("site", NamespaceRole.CHALLENGE, ANSWER)
    index.note(TEMPLATE, YOUNG, 1.0)
    index.note(TEMPLATE, OLD, 2.0)
    assert index.role(TEMPLATE, ANSWER) == (NamespaceRole.WAIT, 2.0 + index.every)
