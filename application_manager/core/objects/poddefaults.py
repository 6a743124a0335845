"""The defaults for the pods of all detectors that a manager runs; a Detector overrides them. Pure."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from wayside.api.pod import RESERVED_VARIABLES

_VARIABLE = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")


USER = 65532  # of our image


@dataclass(frozen=True, slots=True)
class PodDefaults:
    """The defaults in the manager's options.

    Attributes:
        image: of Detectors without an image.
        pull_policy: of all images; None: Kubernetes' default, by the image's tag.
        pull_secrets: for pulling the images; each namespace with detectors has Secrets of these names.
        environment: of the containers, e.g. the endpoint of traces; a Detector's own variables override it.
        metrics_secret: the Secret in each namespace with detectors with the tls.crt and tls.key for metrics and health;
            None: without TLS.
        user: the user of the processes, and the group of their volumes; None: the cluster chooses, as OpenShift does.
    """

    image: str
    pull_policy: str | None = None
    pull_secrets: tuple[str, ...] = ()
    environment: Mapping[str, str] = field(default_factory=dict)
    user: int | None = USER
    metrics_secret: str | None = None


def parse_user(text: str) -> int | None:
    """Parse a user ID, or `cluster` as None. Raises ValueError for anything else, and for root."""
    if text == "cluster":
        return None
    if not text.isdigit() or int(text) == 0:
        raise ValueError(f"must be a user ID other than 0, or `cluster` to let the cluster choose; got {text!r}")
    return int(text)


def parse_environment(pairs: Iterable[str]) -> dict[str, str]:
    """Parse a list of NAME=VALUE. Raises ValueError."""
    found = {}
    for each in pairs:
        name, equals, value = each.partition("=")
        if not equals or _VARIABLE.fullmatch(name) is None:
            raise ValueError(f"must be NAME=VALUE, with a name of letters, digits and _; got {each!r}")
        if name in RESERVED_VARIABLES:
            raise ValueError(f"{name} is set automatically in each pod: remove it")
        found[name] = value
    return found
