"""Rules and Detectors are changed while episodes are open: everything else continues unchanged."""

from __future__ import annotations

from tests.cluster.chain import (
    BETWEEN,
    BUSES,
    CARS,
    FAR,
    HOLDER,
    NEAR,
    VANS,
    Chain,
    Vehicles,
    detector,
    kind_of,
    recording,
    rule,
    template,
    untouched,
)
from tests.cluster.waiting import wait_until

RUNS = f"Detector {HOLDER} runs with"


def test_a_rule_with_a_changed_meaning_ends_its_episodes_and_restarts(chain: Chain, vehicles: Vehicles) -> None:
    chain.apply(template(linger="20s"))
    chain.start()
    vehicles.place(CARS, NEAR)
    vehicles.place(VANS, 140.0)
    deployed = chain.wait_deployed(CARS)
    chain.wait_deployed(VANS)
    chain.apply(rule(when="distance < 120"))
    chain.wait_events(VANS, "started", "RuleChanged")
    first, _, second = chain.wait_events(CARS, "started", "RuleChanged", "started")
    assert first["data"]["episode"] != second["data"]["episode"]
    chain.wait_removed(VANS)
    assert chain.live() == {"+".join(CARS)}
    chain.settled()
    assert untouched(deployed, chain.deployment(CARS)), "the new demand came within the linger"


def test_changed_parameters_of_an_action_reach_the_instance_of_an_open_episode_also_after_a_restart(
    chain: Chain, vehicles: Vehicles
) -> None:
    running = chain.start()
    vehicles.place(CARS, NEAR)
    deployed = chain.wait_deployed(CARS)
    task = chain.wait_task(CARS)
    for rate in (5, 7):
        chain.apply(rule(actions=recording(rate=rate)))
        changed = chain.api.wait_for(
            "Deployment",
            deployed["metadata"]["name"],
            lambda found, rate=rate: found["spec"]["template"]["spec"]["containers"][0]["args"] == [f"--rate={rate}"],
            what="the instance follows",
        )
        assert changed["metadata"]["uid"] == deployed["metadata"]["uid"]
        patched = chain.wait_task(CARS)
        assert patched["metadata"]["uid"] == task["metadata"]["uid"]
        assert patched["spec"]["parameters"] == {"vehicles": list(CARS), "rate": rate}
        running.restart()
        running.wait_for_output(f"{RUNS} 1 rules and 1 restored demands")
    chain.wait_events(CARS, "started")
    chain.settled()


def test_a_detector_is_changed_while_it_runs(chain: Chain, vehicles: Vehicles) -> None:
    running = chain.start()
    pid = running.pid
    vehicles.place(CARS, NEAR)
    deployed = chain.wait_deployed(CARS)
    task = chain.wait_task(CARS)
    vehicles.place(CARS, BETWEEN)
    changed = detector(chain.endpoint)
    changed["spec"]["streams"][0]["staleAfter"] = "3s"
    mood = {"name": "mood", "key": "vehicles/${client:*}/mood", "encoding": "json", "staleAfter": "Never"}
    changed["spec"]["streams"].append(mood)
    happy = rule(
        "happy",
        scope={"client": {}},
        signals=[{"name": "mood", "stream": "mood", "value": "msg.mood"}],
        when='mood == "happy"',
        until='mood == "sad"',
        actions=[],
    )
    chain.apply(changed, happy)
    for feeling, kinds in (("happy", ["started"]), ("sad", ["started", "Until"])):

        def heard(message: bytes = f'{{"mood": "{feeling}"}}'.encode()) -> list[str]:
            vehicles.send("vehicles/car1/mood", message)  # repeatedly: the detector may still be subscribing
            return [kind_of(event) for event in chain.events("car1")]

        wait_until(heard, kinds.__eq__, what="the detector receives the new stream")
    assert untouched(deployed, chain.deployment(CARS))
    assert chain.wait_task(CARS)["metadata"]["uid"] == task["metadata"]["uid"]
    chain.wait_events(CARS, "started")
    assert (running.pid, running.alive) == (pid, True)
    vehicles.place(CARS, FAR)
    chain.wait_events(CARS, "started", "Until")
    chain.wait_removed(CARS)
    chain.settled()


def test_a_detector_changed_to_an_invalid_spec_continues_as_before(chain: Chain, vehicles: Vehicles) -> None:
    running = chain.start()
    vehicles.place(CARS, NEAR)
    deployed = chain.wait_deployed(CARS)
    for field, change in {
        "key": {"key": "vehicles/${client:*}/po$*${se/pose"},
        "type": {"encoding": "cdr", "type": "geometry_msgs/msg/PoseStampd"},
        "stamp": {"stamp": "msg.t +"},
    }.items():
        wrong = detector(chain.endpoint)
        wrong["spec"]["streams"][0] |= change
        chain.apply(wrong)
        running.wait_for_output(rf"cannot apply the new Detector {HOLDER}.*spec\.streams\[0\]\.{field}: ")
    vehicles.place(VANS, NEAR)
    chain.wait_deployed(VANS)
    chain.apply(detector(chain.endpoint, clientTimeout="20m"))
    vehicles.place(BUSES, NEAR)
    chain.wait_deployed(BUSES)
    assert untouched(deployed, chain.deployment(CARS))
    assert (running.starts, running.alive) == (1, True)
    chain.settled()
