"""An explanation as text for people, in the order of the chain."""

from __future__ import annotations

from collections.abc import Iterator

from application_manager.core.claims import values
from application_manager.core.statuses.explanation import ExplainedInstance, ExplainedTask, Explanation

_TASKS_SHOWN = 20
_PODS_SHOWN = 20


def explanation_text(explanation: Explanation) -> str:
    """The explanation as lines, the last one ended too."""
    return "".join(f"{line}\n" for line in _lines(explanation))


def _lines(explanation: Explanation) -> Iterator[str]:
    if explanation.task is not None:
        yield from _task(explanation.task)
    template, instance = explanation.template, explanation.instance
    yield f"template {template.name}" + (f": {template.problem}" if template.problem else "")
    if instance is None:
        task = explanation.task
        of_all = task is not None and task.operation != "Deploy" and task.verdict in ("Counts", "Waiting")
        yield "instances: all instances of the template" if of_all else "instance: none"
        return
    yield from _instance(instance, template.name)
    yield from _tasks(explanation, instance)
    about = {each.name: f" ({each.subject})" for each in explanation.tasks if each.subject}
    if explanation.parameters:
        yield "parameters"
    for each in explanation.parameters:
        origin = {"default": ", the default", "earlier": ", kept from earlier tasks", "none": ""}.get(each.source, "")
        shown = "absent" if each.value is None else values.shown(each.value)
        yield f"  {each.name} = {shown} (merge {each.merge}{origin})" + (f": {each.note}" if each.note else "")
        for part in each.contributions:
            why = f": {part.why}" if part.why else ""
            effect = {"decides": "is used", "part": "is merged", "outbid": "is overridden", "none": "has no effect"}[
                part.effect
            ]
            yield f"    {values.shown(part.value)} of {part.task}{about.get(part.task, '')} {effect}{why}"
    if explanation.objects:
        yield "objects"
    for thing in explanation.objects:
        yield f"  {thing.kind} {thing.name} {thing.problem or 'is ready'}"
    if explanation.pods:
        yield "pods"
    for pod in explanation.pods[:_PODS_SHOWN]:
        where = f" on {pod.node}" if pod.node else ""
        yield f"  {pod.name} {pod.phase}{where}: {pod.problem or ('ready' if pod.ready else 'not ready yet')}"
    yield from _more(len(explanation.pods) - _PODS_SHOWN)


def _task(task: ExplainedTask) -> Iterator[str]:
    yield f"task {task.name} ({task.phase or 'no phase yet'})"
    if task.event is not None:
        onset, start = task.event["onsetTime"], task.event["startTime"]
        times = f"started {start}" if onset == start else f"began {onset}, started {start}"
        yield f"  event: {task.rule} of {task.subject}, {times}"
        for name, value in sorted(task.event.get("values", {}).items()):
            yield f"    {name} = {values.shown(value)}"
    if task.detector or task.holder:
        age = "" if task.lease_age_seconds is None else f", its Lease was renewed {task.lease_age_seconds:g} s ago"
        lost = ", counted as lost" if task.holder_is_lost else ""
        yield f"  requested by detector {task.detector or '(unnamed)'}, holder {task.holder or 'none'}{age}{lost}"
    else:
        yield "  created by a person: it never expires"
    yield f"  {task.operation}, priority {task.priority}, created {task.created or 'just now'}"
    yield f"  {task.verdict}, {task.reason}: {task.message}"
    shown = ("Accepted", "Finished") if task.verdict == "Finished" else ("Accepted",)  # the line above shows it
    yield from _conditions(task.conditions, but=shown)
    if task.unprocessed:
        yield (
            "  the manager has not processed its current generation: does `application-manager run` manage this "
            "namespace?"
        )


def _instance(instance: ExplainedInstance, template: str) -> Iterator[str]:
    is_json = instance.key is not None and instance.key.startswith(("[", "{"))
    key = "" if instance.key is None else f", key {instance.key if is_json else values.shown(instance.key)}"
    state = (instance.phase or "no phase yet") if instance.exists else "not created yet"
    by = "" if instance.managed else ", created by a person"
    of = f" of template {instance.template}" if instance.template not in (None, template) else ""
    yield f"instance {instance.name}{of} ({state}{key}{by})"
    if instance.release_time is not None:
        yield f"  it will be released at {instance.release_time} unless a demand arrives"
    yield from _conditions(instance.conditions)


def _conditions(conditions: list[dict[str, object]], but: tuple[str, ...] = ()) -> Iterator[str]:
    for each in conditions:
        if each["type"] not in but:
            yield f"  {each['type']}={each['status']}, {each['reason']}: {each.get('message', '')}"


def _tasks(explanation: Explanation, instance: ExplainedInstance) -> Iterator[str]:
    yield f"tasks of instance {instance.name}" + ("" if explanation.tasks else ": none")
    # A finished task exists for another hour, and must not displace one that counts.
    for task in sorted(explanation.tasks, key=lambda each: each.verdict == "Finished")[:_TASKS_SHOWN]:
        about = f"{task.rule} of {task.subject}" if task.rule else "by a person" if not task.holder else task.holder
        why = "" if task.verdict == "Counts" else f", {task.reason}: {task.message}"
        yield f"  {task.name} ({about}, {task.operation}, priority {task.priority}) {task.verdict}{why}"
    yield from _more(len(explanation.tasks) - _TASKS_SHOWN)


def _more(count: int) -> Iterator[str]:
    if count > 0:
        yield f"  and {count} more: -o json lists all"
