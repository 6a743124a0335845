"""The run of docs/tutorial.md: a real control plane, both programs, and vehicles at its positions.

There are no nodes, so this also sets the status of pods as a kubelet would. At each step it prints what happens and the
outputs of the commands. With --pause it waits for Enter after each, and you can look for yourself from another
terminal; with --write it puts the output into docs/tutorial.md.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shlex
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import yaml

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
sys.path[:0] = [str(ROOT), str(HERE)]

from cooperative_recording.parked import ParkedVehicles  # noqa: E402
from cooperative_recording.transcript import Uniform  # noqa: E402

from tests.cluster.api import Api, Object, Objects  # noqa: E402  the tests' client is made for looking
from tests.cluster.binaries import ensure_binaries  # noqa: E402
from tests.cluster.controlplane import ControlPlane  # noqa: E402
from tests.cluster.crds import CRDS  # noqa: E402
from tests.cluster.pods import mark_pods_ready  # noqa: E402
from tests.cluster.processes import Processes  # noqa: E402
from tests.cluster.waiting import wait_until  # noqa: E402
from tests.patience import PATIENCE  # noqa: E402
from tests.ports import free_endpoint  # noqa: E402

GUIDE = ROOT / "docs" / "tutorial.md"
NAMESPACE = "town"
LINGER_S = 20
"""Seconds, rather than the example's three: time to look."""
BLOCK = re.compile(r"^```console\n\$ (.*?)^```\n", re.MULTILINE | re.DOTALL)
NOT_FOUND = "rpc error: code = NotFound desc = registry.example/scene-fusion:2: not found"
IMAGE = "/spec/manifests/1/spec/template/spec/containers/0/image"


@dataclass
class Stage:
    """Where it plays."""

    api: Api
    vehicles: ParkedVehicles
    kubectl: Path
    kubeconfig: Path
    uniform: Uniform

    def run(self, command: str) -> str:
        """The command and what it prints. In it, `<fuse shuttle_1+taxi_1>` stands for the name of that task."""
        real = re.sub(r"<(\w+) (\S+)>", lambda found: self.task(found[1], found[2])["metadata"]["name"], command)
        program, *arguments = shlex.split(real)
        argv = (
            [str(self.kubectl)] if program == "kubectl" else [sys.executable, "-m", "application_manager.commands.cli"]
        )
        done = subprocess.run(
            [*argv, *arguments],
            env=os.environ | {"KUBECONFIG": str(self.kubeconfig)},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            check=False,
            timeout=PATIENCE,
        )
        if done.returncode:
            raise RuntimeError(f"{real}: exit code {done.returncode}\n{done.stdout}")
        for task in sorted(self.tasks(), key=_start):
            self.uniform.name_task(task["metadata"]["name"], _about(task))
            event = task["spec"]["event"]
            for time in (event["onsetTime"], event["startTime"], task["metadata"]["creationTimestamp"]):
                self.uniform.note_time(time)
            self.uniform.note_time(task["spec"].get("endTime", ""))
        for instance in self._instances():
            self.uniform.note_time(instance.get("status", {}).get("releaseTime", ""), LINGER_S)
        return f"$ {real}\n{done.stdout}"

    def tasks(self) -> Objects:
        """All tasks."""
        return self.api.list("ApplicationTask")

    def task(self, action: str, subject: str) -> Object:
        """The newest task of that action and subject."""
        return max((each for each in self.tasks() if _about(each) == f"{action} {subject}"), key=_start)

    def wait(self, tasks: Mapping[str, str], instances: Mapping[str, str], *, kubelet: bool = False) -> None:
        """Wait until exactly these tasks and instances exist, in these phases.

        Args:
            tasks: phases, by action and subject; a text after a colon must be part of the message, else there is none.
            instances: likewise, by template and key.
            kubelet: set all pods to running in the meantime.
        """

        def look() -> bool:
            if kubelet:
                mark_pods_ready(self.api)
            made, running = sorted(self.tasks(), key=_start), self._instances()
            newest = {_about(each): each for each in made}
            there = {f"{each['spec']['templateName']} {each['spec']['key']}": each for each in running}
            return (
                _have_come(newest, tasks)
                and _have_come(there, instances)
                and all(_counts(each, made) for each in running)
            )

        wait_until(look, bool, what=f"{tasks}, {instances}", diagnose=self._state)

    def _instances(self) -> Objects:
        return self.api.list("ApplicationInstance")

    def _state(self) -> str:
        return yaml.safe_dump([each.get("status") for each in [*self.tasks(), *self._instances()]])

    def pod(self, image: str) -> str:
        """The name of the one pod with a container of that image, once it is there."""

        def of_image() -> list[str]:
            pods = self.api.list("Pod")
            return [each["metadata"]["name"] for each in pods if each["spec"]["containers"][0]["image"] == image]

        return wait_until(of_image, lambda found: len(found) == 1, what=f"one pod has the image {image}")[0]

    def cannot_pull(self, image: str, why: str) -> None:
        """Set the status of the pod with that image as a kubelet does that cannot pull it."""
        waiting = {"reason": "ErrImagePull", "message": why}
        container = {"name": "fusion", "image": image, "imageID": "", "ready": False, "restartCount": 0}
        status = {"containerStatuses": [{**container, "state": {"waiting": waiting}}]}
        self.api.patch("Pod", self.pod(image), {"status": status}, subresource="status")


def _have_come(found: Mapping[str, Object], wanted: Mapping[str, str]) -> bool:
    """Whether these are the objects, and their statuses have the phase and the part of the message that is wanted."""
    return found.keys() == wanted.keys() and all(
        _has_come(found[name], *wanted[name].split(": ", 1)) for name in wanted
    )


def _has_come(found: Object, phase: str, text: str | None = None) -> bool:
    status = found.get("status", {})
    message = status.get("message")
    return status.get("phase") == phase and (message is None if text is None else text in (message or ""))


def _counts(instance: Object, tasks: Objects) -> bool:
    """Whether the instance's status counts the tasks that are live."""
    name = instance["metadata"]["name"]
    live = [
        each for each in tasks if each.get("status", {}).get("instanceName") == name and "endTime" not in each["spec"]
    ]
    return bool(instance["status"]["demands"]["count"] == len(live))


def _about(task: Object) -> str:
    event = task["spec"]["event"]
    return f"{event['action']} {event['subject']}"


def _start(task: Object) -> str:
    return str(task["spec"]["event"]["startTime"])


@dataclass(frozen=True)
class Step:
    """One step: what happens, until when it is waited, and what is then typed."""

    shows: str
    happens: Callable[[Stage], None]
    commands: tuple[str, ...]


PAIR, OTHERS = "shuttle_1+taxi_1", "taxi_1+taxi_2"
RECORDER, OTHER_RECORDER = 'scene-recorder ["shuttle_1","taxi_1"]', 'scene-recorder ["taxi_1","taxi_2"]'
FUSION = "scene-fusion west"
NOT_YET = "has 0 of 1 pods available"
GOES = "unless a demand arrives"
OVER = "Finished: the demand ended"
LOOK = ("kubectl get apptask", "kubectl get appinst")


def begins(stage: Stage) -> None:
    """Two vehicles are far apart, and all that people wrote was judged."""
    stage.vehicles.put("shuttle_1", -200.0)
    stage.vehicles.put("taxi_1", 100.0)
    for kind in ("EventRule", "Detector", "ApplicationTemplate"):
        stage.api.wait_list(kind, lambda found: all(map(_accepted, found)), what=f"each {kind} is accepted")
    stage.wait({}, {})


def _accepted(raw: Object) -> bool:
    conditions = raw.get("status", {}).get("conditions", [])
    return any((each["type"], each["status"]) == ("Accepted", "True") for each in conditions)


def approaches(stage: Stage) -> None:
    """The taxi comes as close as 100 m."""
    stage.vehicles.put("taxi_1", -100.0)
    stage.wait(both(PAIR, "Active: is not ready yet"), {RECORDER: f"Applied: {NOT_YET}", FUSION: f"Applied: {NOT_YET}"})


def runs(stage: Stage) -> None:
    """The kubelets have started the pods."""
    stage.wait(both(PAIR, "Ready"), {RECORDER: "Ready", FUSION: "Ready"}, kubelet=True)


def joins(stage: Stage) -> None:
    """Another taxi comes close to the first one."""
    stage.vehicles.put("taxi_2", 0.0)
    instances = {RECORDER: "Ready", OTHER_RECORDER: "Ready", FUSION: "Ready"}
    stage.wait(both(PAIR, "Ready") | both(OTHERS, "Ready"), instances, kubelet=True)


def leaves(stage: Stage) -> None:
    """The shuttle is 300 m away."""
    stage.vehicles.put("shuttle_1", -400.0)
    instances = {RECORDER: f"Lingering: {GOES}", OTHER_RECORDER: "Ready", FUSION: "Ready"}
    stage.wait(both(PAIR, OVER) | both(OTHERS, "Ready"), instances)


def ends(stage: Stage) -> None:
    """The recorder of the first pair has gone, and so has the other taxi."""
    tasks = both(PAIR, OVER)
    stage.wait(tasks | both(OTHERS, "Ready"), {OTHER_RECORDER: "Ready", FUSION: "Ready"})
    stage.vehicles.put("taxi_2", 400.0)
    stage.wait(tasks | both(OTHERS, OVER), {OTHER_RECORDER: f"Lingering: {GOES}", FUSION: f"Lingering: {GOES}"})


def gone(stage: Stage) -> None:
    """Nothing runs."""
    stage.wait(both(PAIR, OVER) | both(OTHERS, OVER), {})
    for kind in ("Deployment", "ConfigMap", "ReplicaSet", "Pod"):
        labels = "app.kubernetes.io/managed-by=wayside" if kind == "ConfigMap" else ""
        stage.api.wait_list(kind, lambda found: not found, labels=labels, what=f"no {kind} is left")


def breaks(stage: Stage) -> None:
    """The next version of the fusion has an image that is not there, and the shuttle comes back."""
    stage.vehicles.put("shuttle_1", -200.0)
    stage.pod("registry.example/scene-fusion:2")
    stage.cannot_pull("registry.example/scene-fusion:2", NOT_FOUND)
    mark_pods_ready(stage.api, "app.kubernetes.io/name=scene-recorder")
    tasks = {f"record {PAIR}": "Ready", f"fuse {PAIR}": "Active: cannot pull image"} | both(OTHERS, OVER)
    stage.wait(tasks, {RECORDER: "Ready", FUSION: "Applied: cannot pull image"})


def mended(stage: Stage) -> None:
    """The image is the old one again."""
    stage.wait(both(PAIR, "Ready") | both(OTHERS, OVER), {RECORDER: "Ready", FUSION: "Ready"}, kubelet=True)


def both(pair: str, phase: str) -> dict[str, str]:
    """Both tasks of a pair, in that phase."""
    return {f"record {pair}": phase, f"fuse {pair}": phase}


def patch(image: str) -> str:
    """The command that gives the fusion another image."""
    document = json.dumps([{"op": "replace", "path": IMAGE, "value": image}])
    return f"kubectl patch apptpl scene-fusion --type json -p '{document}'"


STEPS = (
    Step("Two vehicles stand 300 m apart.", begins, ("kubectl get er,det,apptpl", *LOOK)),
    Step("taxi_1 comes closer: 100 m are left.", approaches, LOOK),
    Step("The pods start.", runs, (LOOK[0], f"application-manager explain <fuse {PAIR}>")),
    Step(
        "taxi_2 comes within 100 m of taxi_1.", joins, (LOOK[1], "application-manager explain scene-fusion-o2tzmielof")
    ),
    Step("shuttle_1 drives away.", leaves, (*LOOK, f"application-manager explain <record {PAIR}>")),
    Step("Now taxi_2 leaves as well.", ends, (LOOK[1],)),
    Step("20 s later.", gone, ("kubectl get appinst,deployments,pods", patch("registry.example/scene-fusion:2"))),
    Step("shuttle_1 returns to taxi_1.", breaks, (*LOOK, f"application-manager explain <fuse {PAIR}>")),
    Step("Somebody looks.", lambda _: None, (patch("registry.example/scene-fusion:1"),)),
    Step("The new pod starts.", mended, (LOOK[1],)),
)


def play(stage: Stage, *, pause: Callable[[], None] = lambda: None, report: Callable[[str], None] = print) -> list[str]:
    """Play all steps, and `report` each; returns their uniform outputs: one text per step, including its commands."""
    reported = []
    for number, step in enumerate(STEPS):
        report(f"# {step.shows}")
        stage.uniform.step = number
        step.happens(stage)
        printed = [stage.run(command) for command in step.commands]
        report("".join(printed))
        reported.append("".join(map(stage.uniform.text, printed)))
        pause()
    return reported


@contextmanager
def staged(api: Api, kubectl: Path, folder: Path) -> Iterator[Stage]:
    """The example in the namespace of `api`, both programs at work, and the vehicles. Logs go into `folder`."""
    endpoint = free_endpoint()
    kubeconfig = _of_namespace(api, folder)
    processes = Processes(folder, {"KUBECONFIG": str(kubeconfig)})
    try:
        for file in ("templates.yaml", "rules.yaml", "detector.yaml"):
            for document in yaml.safe_load_all((HERE / file).read_text(encoding="utf-8")):
                document["metadata"]["namespace"] = api.namespace
                if document["kind"] == "Detector":
                    _make_patient(document["spec"])
                    document["spec"]["zenoh"]["listen"] = [endpoint]
                elif document["kind"] == "ApplicationTemplate":
                    document["spec"]["lifecycle"]["linger"] = f"{LINGER_S}s"
                api.apply(document)
        processes.start("application-manager", "run", "--namespace", api.namespace).wait_for_output("watching")
        detector = processes.start("detector", "run", "--name", "town", "--namespace", api.namespace)
        detector.wait_for_output("Detector town runs with 1 rules")
        with ParkedVehicles([endpoint], PATIENCE) as vehicles:
            yield Stage(api, vehicles, kubectl, kubeconfig, Uniform(api.namespace))
    finally:
        processes.kill_all()


def _make_patient(spec: Object) -> None:
    """However slow the machine is: no vehicle is lost because its data come late."""
    spec["clientTimeout"] = "10m"
    for stream in spec["streams"]:
        stream["staleAfter"] = "Never"


def _of_namespace(api: Api, folder: Path) -> Path:
    """A kubeconfig like that of `api` whose default namespace is that of `api`."""
    document: dict[str, Any] = yaml.safe_load(api.kubeconfig.read_text(encoding="utf-8"))
    for context in document["contexts"]:
        context["context"]["namespace"] = api.namespace
    path = folder / "kubeconfig"
    path.touch(mode=0o600)
    path.write_text(yaml.safe_dump(document), encoding="utf-8")
    return path


def blocks(guide: str) -> list[str]:
    """The texts of the tutorial, one for each step."""
    return [f"$ {each}" for each in BLOCK.findall(guide)]


def with_blocks(guide: str, reported: Sequence[str]) -> str:
    """The tutorial with these texts in place of those that it shows. ValueError: it has another number of them."""
    if len(blocks(guide)) != len(reported):
        raise ValueError(f"the tutorial has {len(blocks(guide))} blocks that begin with a command, not {len(reported)}")
    texts = iter(reported)
    return BLOCK.sub(lambda _: f"```console\n{next(texts)}```\n", guide)


def _wait_for_enter() -> None:
    input("# Enter: continue ")


def main() -> int:
    """Play it on a control plane of its own."""
    parser = argparse.ArgumentParser(prog="tutorial.py", description=__doc__)
    parser.add_argument("--pause", action="store_true", help="wait for Enter after each step")
    parser.add_argument("--write", action="store_true", help="put the output into docs/tutorial.md")
    options = parser.parse_args()
    with ExitStack() as stack:
        plane = stack.enter_context(ControlPlane(ensure_binaries(), CRDS))
        plane.api().create({"apiVersion": "v1", "kind": "Namespace", "metadata": {"name": NAMESPACE}})
        folder = Path(stack.enter_context(TemporaryDirectory()))
        api = plane.api(NAMESPACE)
        api.wait_for("ServiceAccount", "default", lambda _: True, what=f"{NAMESPACE} has its service account")
        stage = stack.enter_context(staged(api, plane.binaries.kubectl, folder))
        print("# To look for yourself, type this into another terminal, and then what stands after each $:")
        programs = f"{plane.binaries.kubectl.parent}:{Path(sys.executable).parent}"
        print(f"#   export KUBECONFIG={stage.kubeconfig} PATH={programs}:$PATH")
        reported = play(stage, pause=_wait_for_enter if options.pause else lambda: None)
    if options.write:
        GUIDE.write_text(with_blocks(GUIDE.read_text(encoding="utf-8"), reported), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
