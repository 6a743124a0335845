"""An application that follows its sources while it runs: its configuration reaches it without a restart.

    python follow.py --file /etc/fusion/sources.yaml --zenoh tcp/zenoh:7447 --instance site/fusion

It subscribes to the poses of the vehicles that its configuration names. The configuration comes by two ways:

- as a file, a mounted ConfigMap: always there, also without a network, and the kubelet brings a change within seconds;
- over Zenoh: within milliseconds, from the application manager, who also answers a question at the start.

`Latest` makes one content of the two. Copy what you need: there is nothing to install but eclipse-zenoh and PyYAML.
"""

from __future__ import annotations

import argparse
import json
import signal
import threading
import time
from pathlib import Path

import yaml
import zenoh

POLL = 0.2  # s between two looks at the file: the kubelet replaces a mounted file as a whole, by renaming a link
ASK = 10.0  # s between two queries over Zenoh: changes while our own connection is lost are not repeated
MEMORY = 180.0  # s that a replaced content is remembered; the kubelet brings every change within two minutes


class Latest:
    """The newest content of two ways, of which the one by file is late.

    What came over Zenoh counts at once. The file's content counts too, unless Zenoh has replaced just that content
    within the last `MEMORY` seconds: then the file is only late. Should Zenoh fall silent, the file has the last word.
    """

    def __init__(self) -> None:
        self.content: str | None = None
        self._replaced: dict[str, float] = {}
        self._lock = threading.Lock()

    def by_zenoh(self, content: str, now: float) -> bool:
        """Take what Zenoh brought; whether it is new. `now`: seconds of a clock that never steps."""
        with self._lock:
            if content == self.content:
                return False
            if self.content is not None:
                self._replaced[self.content] = now
            self._replaced.pop(content, None)
            self.content = content
            return True

    def by_file(self, content: str, now: float) -> bool:
        """Take the file's content; returns whether it is new."""
        with self._lock:
            self._replaced = {each: since for each, since in self._replaced.items() if now - since < MEMORY}
            if content == self.content or content in self._replaced:
                return False
            self.content = content
            return True


class Fusion:
    """The application itself: a subscription for each source, changed one by one."""

    def __init__(self, session: zenoh.Session, latest: Latest) -> None:
        self._session = session
        self._latest = latest
        self._sources: dict[str, zenoh.Subscriber[None]] = {}
        self._lock = threading.Lock()

    def follow(self, way: str) -> None:
        """Subscribe to new items and leave removed ones; the others continue without a gap."""
        with self._lock:
            try:  # the newest of all, whichever way and thread it came by
                wanted = set((yaml.safe_load(self._latest.content or "") or {}).get("sources") or [])
            except (yaml.YAMLError, AttributeError) as error:
                print(f"a configuration that cannot be read is left aside: {error}", flush=True)
                return
            for source in self._sources.keys() - wanted:
                self._sources.pop(source).undeclare()  # type: ignore[no-untyped-call]
            for source in wanted - self._sources.keys():
                self._sources[source] = self._session.declare_subscriber(f"vehicles/{source}/pose", self._take)
            print(f"following {', '.join(sorted(wanted)) or 'nobody'} (by {way})", flush=True)

    def _take(self, sample: zenoh.Sample) -> None:
        print(f"{sample.key_expr}: {sample.payload.to_string()}", flush=True)


def main() -> None:
    """Follow until SIGTERM."""
    options = argparse.ArgumentParser(description="Follows its sources while it runs.")
    options.add_argument("--file", type=Path, required=True, help="the configuration's file, in the mounted ConfigMap")
    options.add_argument("--zenoh", required=True, help="where Zenoh is, e.g. tcp/zenoh:7447")
    options.add_argument("--instance", required=True, help="<namespace>/<name> of the ApplicationInstance")
    given = options.parse_args()
    ended = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: ended.set())

    latest, key = Latest(), f"wayside/instances/{given.instance}/configuration"
    config = zenoh.Config()
    for path, value in (("mode", "peer"), ("connect/endpoints", [given.zenoh]), ("scouting/multicast/enabled", False)):
        config.insert_json5(path, json.dumps(value))
    with zenoh.open(config) as session:
        fusion = Fusion(session, latest)

        def reported(sample: zenoh.Sample) -> None:
            if sample.kind == zenoh.SampleKind.DELETE:
                return  # the instance is gone, and so are we soon
            content = json.loads(sample.payload.to_bytes()).get(given.file.name)
            if content is not None and latest.by_zenoh(content, time.monotonic()):
                fusion.follow("zenoh")

        def answered(reply: zenoh.Reply) -> None:
            if reply.ok is not None:
                reported(reply.ok)

        subscriber = session.declare_subscriber(key, reported)  # first: what changes while we ask is not missed
        requested = float("-inf")
        while not ended.wait(POLL):
            if time.monotonic() - requested >= ASK:
                requested = time.monotonic()
                session.get(key, answered)
            try:
                content = given.file.read_text()
            except OSError:
                continue  # not there yet
            if latest.by_file(content, time.monotonic()):
                fusion.follow("file")
        subscriber.undeclare()  # type: ignore[no-untyped-call]


if __name__ == "__main__":
    main()
