"""Draw the demo's drive as drive.svg: the network, the lidar vehicles' tracks, and the expected applications."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from cooperative_recording.expected import Episode, episodes, fusions
from cooperative_recording.network import ROADS, Floats
from cooperative_recording.seeds import DEMO_DURATION_S, DEMO_SEED
from cooperative_recording.vehicles import LIDAR_VEHICLES, Drive, simulate

COLOURS = dict(
    zip(
        (vehicle.name for vehicle in LIDAR_VEHICLES),
        ("#1b6ca8", "#5aa9e6", "#d1495b", "#e08e45", "#3a7d44", "#8e5ea2"),
        strict=True,
    )
)
LEFT, TOP, SCALE = 740.0, 410.0, 0.6
"""The map's corner in metres west and north of its origin, and pixels per metre."""
BARS_LEFT, BARS_TOP, BAR, SECOND = 200, 530, 22, 26
"""Where the timeline begins, the height of a line and the width of a second, in pixels."""


def svg(drive: Drive, duration_s: float) -> str:
    """The picture of the drive's first duration_s seconds."""
    found = episodes(drive, duration_s)
    rows = [*_timeline(drive, found, duration_s)]
    height = BARS_TOP + BAR * (len({episode.pair for episode in found}) + 2) + 40
    return "\n".join(
        [
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 890 {height}" '
            'font-family="sans-serif" font-size="12">',
            f'<rect width="890" height="{height}" fill="#fff"/>',
            *_map(drive, found, duration_s),
            *rows,
            "</svg>\n",
        ]
    )


def _map(drive: Drive, found: list[Episode], duration_s: float) -> Iterator[str]:
    for road in ROADS:
        points = road.points()
        line = _path(points if road.centre else points[[0, -1]], every=12)
        yield f'<path d="{line}" fill="none" stroke="#ddd" stroke-width="8"/>'
    for x, name in ((-330.0, "west"), (330.0, "east")):
        px, py = _pixels(np.array([[x, 0.0]]))[0]
        yield f'<text x="{px:.0f}" y="{py - 30:.0f}" fill="#888" text-anchor="middle">{name}</text>'
    times = np.arange(0.0, duration_s + 0.01, 0.5)
    for name, colour in COLOURS.items():
        track = drive.poses(name, times)[:, :2]
        x, y = _pixels(track)[0]
        yield f'<path d="{_path(track)}" fill="none" stroke="{colour}" stroke-width="2"/>'
        yield f'<circle cx="{x:.1f}" cy="{y:.1f}" r="4" fill="{colour}"/>'
        yield f'<text x="{x + 6:.0f}" y="{y - 6:.0f}" fill="{colour}">{name}</text>'
    for number, episode in enumerate(found, start=1):
        ends = np.array([[(pose := drive.pose(name, episode.start_s)).x, pose.y] for name in episode.pair])
        (ax, ay), (bx, by) = _pixels(ends)
        x, y = (ax + bx) / 2, (ay + by) / 2
        yield f'<line x1="{ax:.1f}" y1="{ay:.1f}" x2="{bx:.1f}" y2="{by:.1f}" stroke="#333" stroke-dasharray="3 3"/>'
        yield f'<circle cx="{x:.1f}" cy="{y:.1f}" r="8" fill="#333"/>'
        yield f'<text x="{x:.1f}" y="{y + 4:.1f}" fill="#fff" text-anchor="middle" font-size="11">{number}</text>'


def _timeline(drive: Drive, found: list[Episode], duration_s: float) -> Iterator[str]:
    pairs = list(dict.fromkeys(episode.pair for episode in found))
    yield f'<text x="{BARS_LEFT - 8}" y="{BARS_TOP - 8}" text-anchor="end" fill="#888">seconds</text>'
    for second in range(0, int(duration_s) + 1, 5):
        x = BARS_LEFT + second * SECOND
        yield f'<text x="{x}" y="{BARS_TOP - 8}" text-anchor="middle" fill="#888">{second}</text>'
        bottom = BARS_TOP + BAR * (len(pairs) + 2)
        yield f'<line x1="{x}" y1="{BARS_TOP}" x2="{x}" y2="{bottom}" stroke="#eee"/>'
    for row, pair in enumerate(pairs):
        yield _label(row, f"recorder {' '.join(pair)}")
        for number, episode in enumerate(found, start=1):
            if episode.pair == pair:
                yield _bar(row, episode.start_s, episode.end_s or duration_s, "#333", str(number))
    for row, (place, states) in enumerate(fusions(found, linger_s=0.0).items(), start=len(pairs)):
        yield _label(row, f"fusion {place}")
        for state in states:
            end = state.end_s or duration_s
            yield _bar(row, state.start_s, end, "#b9c4cf", "")
            for index, source in enumerate(state.sources):
                middle = BARS_LEFT + state.start_s * SECOND + 8 + 10 * index
                yield f'<circle cx="{middle:.1f}" cy="{BARS_TOP + BAR * row + 10}" r="4" fill="{COLOURS[source]}"/>'


def _label(row: int, text: str) -> str:
    return f'<text x="{BARS_LEFT - 8}" y="{BARS_TOP + BAR * row + 14}" text-anchor="end">{text}</text>'


def _bar(row: int, start: float, end: float, colour: str, text: str) -> str:
    x, y = BARS_LEFT + start * SECOND, BARS_TOP + BAR * row
    return (
        f'<rect x="{x:.1f}" y="{y + 2}" width="{(end - start) * SECOND:.1f}" height="{BAR - 6}" '
        f'fill="{colour}" stroke="#fff"/>'
        f'<text x="{x + 6:.1f}" y="{y + 14}" fill="#fff" font-size="11">{text}</text>'
    )


def _pixels(points: Floats) -> Floats:
    return np.column_stack([points[:, 0] + LEFT, TOP - points[:, 1]]) * SCALE


def _path(points: Floats, every: int = 1) -> str:
    kept = points if len(points) < 3 else points[sorted({*range(0, len(points), every), len(points) - 1})]
    return "M" + " L".join(f"{x:.1f},{y:.1f}" for x, y in _pixels(kept))


if __name__ == "__main__":
    picture = svg(simulate(DEMO_SEED), DEMO_DURATION_S)
    (Path(__file__).parent / "drive.svg").write_text(picture, encoding="utf-8")
