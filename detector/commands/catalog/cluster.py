"""The rules of a cluster, for a catalog."""

from __future__ import annotations

from detector.commands.catalog.catalog import CatalogEntry, Read, entry
from detector.resources.kubernetes import EVENT_RULES, PROGRAM
from wayside.api import API_VERSION, EventRule
from wayside.api.documents import parse_object
from wayside.kubernetes.connection import ConfigurationError, connect
from wayside.kubernetes.errors import RequestError

_OTHERWISE = "give either files or folders with EventRules, or --cluster"


async def read_cluster(namespace: str | None) -> Read:
    """The EventRules of the namespace. Unreadable ones, e.g. of a newer version, are reported and left out.

    Args:
        namespace: default: the kubeconfig context's, or the pod's own.

    Raises:
        ConfigurationError: there is neither a kubeconfig nor a pod's account, or the API server forbids the list.
    """
    entries: list[CatalogEntry] = []
    unreadable: list[str] = []
    async with connect(PROGRAM, namespace, otherwise=_OTHERWISE) as cluster:
        try:
            listed, _ = await cluster.client.list(EVENT_RULES, cluster.namespace)
        except RequestError as error:
            raise ConfigurationError(
                f"cannot list the EventRules of namespace {cluster.namespace}: {error}. Check that "
                "KUBECONFIG points to the right cluster, and that its account may list "
                "eventrules.wayside.dev there"
            ) from error
        for each in listed:
            # The manager owns the status, and a newer manager's may have unknown fields.
            read = {name: value for name, value in each.items() if name != "status"}
            try:
                rule = parse_object({"apiVersion": API_VERSION, "kind": EventRule.__name__} | read)
            except ValueError as error:
                unreadable.append(f"EventRule {each['metadata']['name']}: {error}")
                continue
            assert isinstance(rule, EventRule)  # noqa: S101  the resource defines it
            entries.append(entry(rule, f"namespace {rule.namespace}"))
    return Read(tuple(entries), tuple(unreadable))
