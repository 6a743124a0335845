"""Which templates are computed in the manager itself: those whose expressions only read, and that are small.

`${parameters.region}` costs no more than to write it down. A worker process would cost more than the work: two switches
between processes, while other work waits for the same processors.
"""

from __future__ import annotations

import json
import re
from typing import Any

from wayside.api import ApplicationInstance, ApplicationTemplate

_READ = re.compile(r"\$\{\s*(?:parameters|instance)(?:\.[A-Za-z_]\w*)+\s*\}")
_LARGEST = 32 * 1024  # characters of a template's objects and files
_MOST = 256  # expressions in them
_VALUES = 16 * 1024  # characters of the values: with the above, of 4 MB at most


def reads_alone(text: str) -> bool:
    """Whether all expressions in the text only read a parameter or a field of the instance."""
    return "${" not in _READ.sub("", text)


def claims_are_plain(template: ApplicationTemplate) -> bool:
    """Whether what a task of the template claims takes no expression but plain reads of parameters."""
    patterns = (each.pattern for each in template.spec.parameters.values())
    return reads_alone(template.spec.key or "") and all(each is None for each in patterns)


def objects_are_plain(template: ApplicationTemplate) -> bool:
    """Whether the objects of the template's instances take none but such reads, and few of them."""
    if template.spec.helm is not None:
        return False
    text = _text([template.spec.manifests, template.spec.configuration])
    return len(text) <= _LARGEST and text.count("${") <= _MOST and reads_alone(text)


def values_are_small(instance: ApplicationInstance) -> bool:
    """Whether the instance's values are too small to make much of, however often they are read."""
    return len(_text(instance.spec.parameters)) <= _VALUES


def _text(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False, default=str)
