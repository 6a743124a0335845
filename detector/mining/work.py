"""A worker's job: one recording, some rules; the result is plain data."""

from __future__ import annotations

import shutil
from collections.abc import Iterable, Sequence
from contextlib import closing
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import NamedTuple

import msgspec

from detector.actions.record.description import DESCRIPTION
from detector.actions.record.destination import finished_recordings
from detector.assembly.memory import tune_garbage_collection
from detector.mining.sources import InputRecording, fetched
from detector.plugins.outages import Outages
from detector.plugins.processes import REPLAY_PATIENCE, ProcessHost
from detector.replay.clips import Clips
from detector.replay.gathering import Recording
from detector.replay.playing import play
from detector.replay.replaying import ReplayResult
from detector.results.episodes import EpisodeRow
from detector.results.nearest import NearMoment
from detector.results.quality import Arrivals, StreamQuality
from detector.results.result import Result, result_of
from detector.results.tracing import Tracer
from wayside.api import Detector, EventRule
from wayside.inputerror import InputError

_DIGITS = 12
"""Number of digits of the content's digest in the name of the holder: ids of episodes differ even for recordings with
the same beginning."""


class MiningProblem(msgspec.Struct, frozen=True, order=True):
    """A problem of a recording, or of a rule over it."""

    kind: str
    """`unreadable`: nothing was mined; `cut`: the recording is truncated; `refused`: a rule does not fit; `failed`:
    mining failed for a possibly temporary reason, so the next run retries it."""
    message: str
    rule: str | None = None


class RuleCount(msgspec.Struct, frozen=True):
    """The counts of a rule's evaluations."""

    rule: str
    evaluations: int
    unknown: int
    errors: int


class RecordingResult(msgspec.Struct):
    """The result of a recording, for some rules."""

    episodes: list[EpisodeRow] = []
    """In order of the rules, then of their starts; without the recording's name."""
    counts: list[RuleCount] = []
    streams: list[StreamQuality] = []
    flaws: list[MiningProblem] = []
    nearest: list[NearMoment] = []
    """The near misses of rules with a margin; they name no recording."""
    clips: dict[str, list[str]] = {}
    """By episode, the folders of its clips, in the folder of the job."""
    samples: int = 0
    begin: int = 0
    end: int = 0
    """When the first and the last sample were received, nanoseconds since the epoch; 0: there were none."""

    @property
    def is_failed(self) -> bool:
        """Whether another attempt may succeed."""
        return any(flaw.kind == "failed" for flaw in self.flaws)


class MiningJob(NamedTuple):
    """One recording, and the rules to run over it."""

    source: InputRecording
    content: str
    detector: Detector
    rules: Sequence[EventRule]
    """All rules to evaluate."""
    wanted: frozenset[str]
    """The rules whose episodes are kept: the others are evaluated because these read their episodes."""
    clips: str | None
    """The folder for clips of this job only; None: no clips."""


def mine_recording(job: MiningJob) -> bytes:
    """Mine one recording; returns a `RecordingResult` as msgpack, including the recording's problems."""
    tuned()
    return msgspec.msgpack.encode(_mined(job))


@cache
def tuned() -> None:
    """Tune this process once; the objects that exist then are treated as permanent."""
    tune_garbage_collection()


def decode_mined(data: bytes) -> RecordingResult:
    """The inverse of the encoding of `mine_recording`. Raises msgspec.DecodeError if another version wrote it."""
    return msgspec.msgpack.decode(data, type=RecordingResult)


def _mined(job: MiningJob) -> RecordingResult:
    recording: Recording = ()
    try:
        with fetched(job.source) as recording:
            return _replayed(job, recording)
    except (InputError, ExceptionGroup) as error:
        causes = error.exceptions if isinstance(error, ExceptionGroup) else (error,)
        return RecordingResult(
            flaws=[MiningProblem("unreadable", "; ".join(_plain(str(each), recording) for each in causes))]
        )
    except OSError as error:
        return RecordingResult(flaws=[MiningProblem("failed", _plain(str(error), recording))])
    except Exception as error:  # noqa: BLE001  one recording of thousands must not stop the others
        return RecordingResult(
            flaws=[MiningProblem("failed", f"{type(error).__name__}: {error}: run `detector replay` to see where")]
        )


def _plain(text: str, recording: Recording) -> str:
    """The text with only the names of files, so that it does not depend on their folder."""
    for path in recording:
        text = text.replace(str(path), path.name)
    return text


def _replayed(job: MiningJob, recording: Recording) -> RecordingResult:
    tracer, arrivals = Tracer(dict.fromkeys(job.wanted), paths=False), Arrivals()
    clips = None if job.clips is None else _clips(Path(job.clips))
    played = play(
        [recording],
        job.detector,
        job.rules,
        lambda: closing(ProcessHost(Outages(lambda: ()), wait=True, patience=REPLAY_PATIENCE)),
        arrivals.watch_batches,
        lambda _: tracer,
        clips,
        job_holder(job),
    )
    (outcome,) = played.outcomes.values()
    result = result_of(job.source.name, outcome, tracer, arrivals)
    # The last tick of one rule must not affect the statistics of another: which rules run together may differ.
    mined = mined_of(replace(result, trace=replace(result.trace, end=outcome.end)), job.wanted)
    mined.begin, mined.end = arrivals.span
    mined.flaws = sorted(_flaws(outcome, job, recording))
    mined.clips = {} if clips is None else _clips_by_episode(clips.folder)
    return mined


def job_holder(job: MiningJob) -> str:
    """The holder of the job's episodes."""
    return f"{job.detector.name}.{job.content[:_DIGITS]}"


def mined_of(result: Result, wanted: frozenset[str]) -> RecordingResult:
    """The cached part of a replay's result; flaws and clips are added later."""
    episodes = [each for each in result.episodes if each.rule in wanted]
    for each in episodes:
        each.recording = ""
    return RecordingResult(
        episodes=in_their_order(episodes),
        counts=[RuleCount(name, *counts) for name, counts in sorted(result.counts.items()) if name in wanted],
        streams=[*result.streams],
        nearest=[each._replace(recording="") for each in result.nearest if each.rule in wanted],
        samples=result.samples,
    )


def in_their_order(episodes: Iterable[EpisodeRow]) -> list[EpisodeRow]:
    """In the order of a `RecordingResult`."""
    return sorted(episodes, key=lambda each: (each.rule, each.start_time, each.subject))


def _flaws(outcome: ReplayResult, job: MiningJob, recording: Recording) -> list[MiningProblem]:
    cuts = [MiningProblem("cut", _plain(str(cut), recording)) for cut in outcome.cuts]
    refusals = [
        MiningProblem("refused", str(refusal), refusal.rule.name)
        for refusal in outcome.refusals
        if refusal.rule.name in job.wanted
    ]
    return [*cuts, *refusals]


def _clips(folder: Path) -> Clips:
    """Raises OSError."""
    shutil.rmtree(folder, ignore_errors=True)  # from an attempt that was killed
    return Clips(folder)


def _clips_by_episode(folder: Path) -> dict[str, list[str]]:
    found: dict[str, list[str]] = {}
    for kept in finished_recordings(folder):
        description = msgspec.json.decode((kept.path / DESCRIPTION).read_bytes())
        found.setdefault(str(description["episode"]), []).append(kept.path.relative_to(folder).as_posix())
    return {episode: sorted(names) for episode, names in sorted(found.items())}
