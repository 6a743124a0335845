"""Pictures of scenarios: curves and bars over time, as SVG. The same input gives the same bytes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from html import escape

COLOURS = ("#1b6ca8", "#d1495b", "#3a7d44", "#e08e45", "#8e5ea2", "#5aa9e6")
DARK, PALE, GREY = "#333", "#b9c4cf", "#888"
_WIDTH, _LEFT, _RIGHT, _TOP = 890, 190, 20, 30
_PANEL, _GAP, _BAR = 110, 26, 22

Points = Sequence[tuple[float, float]]
"""Seconds and values."""


@dataclass(slots=True)
class Chart:
    """Panels below each other that share one axis of time, `duration_s` seconds long."""

    duration_s: float
    _parts: list[str] = field(default_factory=list)
    _y: float = _TOP

    def curves(
        self, title: str, curves: Sequence[tuple[str, Points]], low: float, high: float,
        threshold: tuple[str, float] | None = None,
    ) -> None:  # fmt: skip
        """A panel with named curves between two values, and perhaps a named threshold."""
        top = self._y + _GAP
        self._text(_LEFT - 8, top + 4, f"{high:g}", "end", GREY)
        self._text(_LEFT - 8, top + _PANEL + 4, f"{low:g}", "end", GREY)
        self._text(_LEFT, top - 8, title, "start", DARK)
        self._parts.append(
            f'<rect x="{_LEFT}" y="{top:.1f}" width="{_WIDTH - _LEFT - _RIGHT}" height="{_PANEL}" '
            'fill="#fafafa" stroke="#ddd"/>'
        )

        def height(value: float) -> float:
            return top + _PANEL * (high - min(max(value, low), high)) / (high - low)

        if threshold is not None:
            name, value = threshold
            y = height(value)
            self._parts.append(
                f'<line x1="{_LEFT}" y1="{y:.1f}" x2="{_WIDTH - _RIGHT}" y2="{y:.1f}" stroke="{DARK}" '
                'stroke-dasharray="4 3"/>'
            )
            self._text(_LEFT + 6, y - 4, name, "start", DARK)
        for index, (name, points) in enumerate(curves):
            colour = COLOURS[index % len(COLOURS)]
            line = " L".join(f"{self._x(at):.1f},{height(value):.1f}" for at, value in points)
            self._parts.append(f'<path d="M{line}" fill="none" stroke="{colour}" stroke-width="1.6"/>')
            self._text(8, top + 14 + 16 * index, name, "start", colour)
        self._y = top + _PANEL

    def bars(
        self, title: str, rows: Sequence[tuple[str, Sequence[tuple[float, float, str]]]], colour: str = DARK
    ) -> None:
        """A panel with a row of bars for each name: from second, to second, and what stands in it."""
        top = self._y + _GAP
        self._text(_LEFT, top - 8, title, "start", DARK)
        for index, (name, spans) in enumerate(rows):
            y = top + _BAR * index
            self._parts.append(
                f'<rect x="{_LEFT}" y="{y + 2:.1f}" width="{_WIDTH - _LEFT - _RIGHT}" height="{_BAR - 6}" '
                'fill="#f2f2f2"/>'
            )
            self._text(_LEFT - 8, y + 14, name, "end", DARK)
            for start, end, label in spans:
                left, right = self._x(start), self._x(min(end, self.duration_s))
                self._parts.append(
                    f'<rect x="{left:.1f}" y="{y + 2:.1f}" width="{max(right - left, 2):.1f}" height="{_BAR - 6}" '
                    f'fill="{colour}"/>'
                )
                self._text(left + 5, y + 14, label, "start", "#fff")
        self._y = top + _BAR * len(rows)

    def svg(self) -> str:
        """The picture."""
        bottom = self._y + 8
        step = next(
            each for each in (1, 2, 5, 10, 20, 30, 60, 120, 300, 600, 1800, 3600) if self.duration_s / each <= 14
        )
        axis = []
        for second in range(0, int(self.duration_s) + 1, step):
            x = self._x(second)
            axis.append(f'<line x1="{x:.1f}" y1="{_TOP}" x2="{x:.1f}" y2="{bottom:.1f}" stroke="#eee"/>')
            axis.append(f'<text x="{x:.1f}" y="{_TOP - 8}" fill="{GREY}" text-anchor="middle">{second}</text>')
        head = (
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH} {bottom + 10:.0f}" '
            'font-family="sans-serif" font-size="12">'
        )
        whole = f'<rect width="{_WIDTH}" height="{bottom + 10:.0f}" fill="#fff"/>'
        label = f'<text x="{_LEFT - 8}" y="{_TOP - 8}" fill="{GREY}" text-anchor="end">seconds</text>'
        return "\n".join([head, whole, label, *axis, *self._parts, "</svg>", ""])

    def _x(self, second: float) -> float:
        return _LEFT + (_WIDTH - _LEFT - _RIGHT) * second / self.duration_s

    def _text(self, x: float, y: float, text: str, anchor: str, colour: str) -> None:
        if text:
            self._parts.append(
                f'<text x="{x:.1f}" y="{y:.1f}" fill="{colour}" text-anchor="{anchor}">{escape(text)}</text>'
            )
