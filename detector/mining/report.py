"""report.html: a dataset as one self-contained page, with links to its clips."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from html import escape
from pathlib import Path
from typing import Any
from urllib.parse import quote

from detector.mining.dataset import EPISODES
from detector.mining.summary import Summary
from detector.results.report import html_page
from wayside.times import format_time

REPORT = "report.html"
_EPISODES = 200
"""Maximum number of listed episodes per rule."""
_ROWS = 500
"""Maximum number of rows in other tables."""

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; margin: 0 auto; max-width: 75rem; padding: 1rem; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
th, td { border-bottom: 1px solid #8884; padding: .2rem .8rem .2rem 0; text-align: left; vertical-align: top; }
td.n, th.n { text-align: right; }
.scroll { overflow-x: auto; }
.hint { opacity: .75; }
input { font: inherit; max-width: 100%; width: 24rem; }
"""
_BODY = """<h1>Mined recordings</h1>
<p>{brief}</p>
<p><label>Only rows with <input id="filter" type="search" placeholder="a rule, a recording, a vehicle"></label></p>
{sections}
<script>
const filter = document.getElementById("filter");
filter.addEventListener("input", () => {{
  const wanted = filter.value.toLowerCase();
  for (const row of document.querySelectorAll("tbody tr"))
    row.hidden = !row.textContent.toLowerCase().includes(wanted);
}});
</script>"""


def write_mining_report(folder: Path, summary: Summary) -> None:
    """Write the page beside its dataset. Raises OSError."""
    brief = (
        f"{summary.recordings_read} recordings, {summary.seconds / 3600:.1f} hours, {summary.samples} samples, "
        f"{sum(rule.episodes for rule in summary.rules)} episodes, {len(summary.errors)} errors"
    )
    page = html_page(
        "Mined recordings",
        _BODY.format(brief=brief, sections="\n".join(_sections(folder, summary))),
        style=_STYLE,
        policy="style-src 'unsafe-inline'; script-src 'unsafe-inline'",
    )
    (folder / REPORT).write_text(page, encoding="utf-8")


def _sections(folder: Path, summary: Summary) -> Iterator[str]:
    yield _section(
        "Rules",
        "The rarest first.",
        ["rule", "#episodes", "#recordings", "#in all, s", "#longest, s", "#evaluations", "#unknown", "#errors"],
        [
            [each.rule, each.episodes, each.recordings, f"{each.total:.1f}", f"{each.longest:.1f}", each.evaluations,
             each.unknown, each.errors]
            for each in summary.rules
        ],
    )  # fmt: skip
    names = [rule.rule for rule in summary.rules if rule.episodes]
    yield _section(
        "Recordings",
        "Those with most episodes first.",
        ["recording", "#episodes", *(f"#{name}" for name in names)],
        [
            [name, sum(by_rule.values()), *(by_rule.get(rule, "") for rule in names)]
            for name, by_rule in summary.recordings[:_ROWS]
        ],
        len(summary.recordings),
    )
    if summary.nearest:
        yield _section(
            "Nearest without an episode",
            "Only rules with a margin. At 0 or below, the condition was not true; above 0, it was not true for long "
            "enough.",
            ["rule", "recording", "subject", "time", "#margin"],
            [
                [each.rule, each.recording, each.subject, format_time(each.time), f"{each.margin:.3g}"]
                for each in summary.nearest
            ],
        )
    if summary.errors:
        rows = [[each["recording"], each["kind"], each["rule"] or "", each["message"]] for each in summary.errors]
        yield _section("Errors", "", ["recording", "kind", "rule", "message"], rows[:_ROWS], len(rows))
    for rule in summary.rules:
        if rule.episodes:
            yield _episodes(folder, rule.rule, rule.episodes)


def _episodes(folder: Path, rule: str, count: int) -> str:
    """The first episodes of a rule, with their values at the start."""
    import pyarrow.parquet as pq  # noqa: PLC0415  an extra

    with pq.ParquetFile(folder / EPISODES / f"rule={rule}" / "part-0.parquet") as file:
        rows = next(file.iter_batches(_EPISODES)).to_pylist()
    signals = [name for name in rows[0] if name.endswith(".start") and any(row[name] is not None for row in rows)]
    with_clips = any(row.get("clips") for row in rows)
    cells = [
        [row["recording"], row["subject"], _time(row["start_time"]), _number(row["duration"]), row["reason"] or "open",
         *(_number(row[name]) for name in signals), *([_Links(row["clips"])] if with_clips else [])]
        for row in rows
    ]  # fmt: skip
    names = [f"#{name.removesuffix('.start')}" for name in signals]
    head = ["recording", "subject", "start", "#seconds", "ended by", *names, *(["clips"] if with_clips else [])]
    return _section(rule, "Episodes, with the values at their start.", head, cells, count)


class _Links(list[str]):
    """Links to folders of clips."""


def _section(
    title: str, hint: str, head: Sequence[str], rows: Sequence[Sequence[Any]], count: int | None = None
) -> str:
    """A table; columns whose name begins with # contain numbers. `count`: the total number of rows, if there may be
    more."""
    if count is not None and count > len(rows):
        hint = f"{hint} {len(rows)} of {count} rows."
    parts = [f"<h2>{escape(title)}</h2>", f'<p class="hint">{escape(hint.strip())}</p>', '<div class="scroll"><table>']
    parts += ["<thead><tr>", *(_cell("th", name.lstrip("#"), name) for name in head), "</tr></thead><tbody>"]
    for row in rows:
        parts += ["<tr>", *(_cell("td", value, name) for value, name in zip(row, head, strict=True)), "</tr>"]
    return "".join([*parts, "</tbody></table></div>"])


def _cell(kind: str, value: Any, column: str) -> str:
    text = _linked(value) if isinstance(value, _Links) else escape(str(value))
    return f'<{kind} class="n">{text}</{kind}>' if column.startswith("#") else f"<{kind}>{text}</{kind}>"


def _linked(folders: Iterable[str]) -> str:
    return " ".join(f'<a href="{quote(each)}/">{escape(Path(each).name)}</a>' for each in folders)


def _time(time: Any) -> str:
    return str(time.strftime("%Y-%m-%d %H:%M:%S.%f")[:-3])


def _number(value: Any) -> str:
    return "" if value is None else f"{value:.6g}" if isinstance(value, float) else str(value)
