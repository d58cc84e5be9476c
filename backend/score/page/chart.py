"""Line charts as SVG inside a page. Colours and letters follow the page's style, so that it may be light or dark."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

WIDTH, HEIGHT = 640, 320
_LEFT, _RIGHT, _TOP, _BOTTOM = 52, 12, 12, 44
_MOST_TICKS = 6
_MOST_MARKS = 50  # points; a line of more has none
_DASHES = ("", "7 4", "2 3", "9 3 2 3", "4 4", "1 4", "12 4")


@dataclass(frozen=True, slots=True, kw_only=True)
class Line:
    """points: (x, y) in rising x. is_ours: drawn on top and thicker."""

    name: str
    points: Sequence[tuple[float, float]]
    is_ours: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Chart:
    """title: read to those who do not see the picture."""

    title: str
    x_label: str
    y_label: str
    lines: Sequence[Line]


def drawn(chart: Chart) -> str:
    """An SVG element and its legend; an empty text where there is nothing to draw."""
    points = [point for line in chart.lines for point in line.points]
    if len({x for x, _ in points}) < 2:
        return ""
    x_ticks, y_ticks = _ticks([x for x, _ in points]), _ticks([y for _, y in points])
    x_span = min(x for x, _ in points), max(x for x, _ in points)
    y_span = min(y_ticks[0], *(y for _, y in points)), max(y_ticks[-1], *(y for _, y in points))

    def place(x: float, y: float) -> tuple[float, float]:
        across = (x - x_span[0]) / (x_span[1] - x_span[0])
        up = (y - y_span[0]) / (y_span[1] - y_span[0])
        return _LEFT + across * (WIDTH - _LEFT - _RIGHT), HEIGHT - _BOTTOM - up * (HEIGHT - _TOP - _BOTTOM)

    parts = [
        f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{escape(chart.title, quote=True)}">',
        *_grid(x_ticks, y_ticks, x_span, place),
        f'<text x="{(WIDTH + _LEFT) / 2:.0f}" y="{HEIGHT - 6}" text-anchor="middle">{escape(chart.x_label)}</text>',
        f'<text transform="translate(14 {HEIGHT / 2 - 16:.0f}) rotate(-90)" text-anchor="middle">{escape(chart.y_label)}</text>',
    ]
    order = sorted(range(len(chart.lines)), key=lambda index: chart.lines[index].is_ours)
    parts += [_path(chart.lines[index], index, place) for index in order]
    return "".join(parts) + "</svg>" + _legend(chart.lines)


def _grid(x_ticks: Sequence[float], y_ticks: Sequence[float], x_span: tuple[float, float], place) -> list[str]:
    found = []
    for tick in y_ticks:
        _, y = place(x_span[0], tick)
        found.append(f'<line class="grid" x1="{_LEFT}" x2="{WIDTH - _RIGHT}" y1="{y:.1f}" y2="{y:.1f}"/>')
        found.append(f'<text x="{_LEFT - 6}" y="{y + 4:.1f}" text-anchor="end">{tick:g}</text>')
    for tick in x_ticks:
        if x_span[0] <= tick <= x_span[1]:
            x, _ = place(tick, y_ticks[0])
            found.append(f'<text x="{x:.1f}" y="{HEIGHT - _BOTTOM + 16}" text-anchor="middle">{tick:g}</text>')
    return found


def _path(line: Line, index: int, place) -> str:
    places = [place(x, y) for x, y in line.points]
    corners = " ".join(f"{x:.1f},{y:.1f}" for x, y in places)
    kind = f"line c{index % 7}" + (" ours" if line.is_ours else "")
    marks = "".join(f'<circle class="{kind}" cx="{x:.1f}" cy="{y:.1f}" r="2.4"/>' for x, y in places)
    return f'<polyline class="{kind}" stroke-dasharray="{_DASHES[index % 7]}" points="{corners}"/>' + (
        marks if len(places) <= _MOST_MARKS else ""
    )


def _legend(lines: Sequence[Line]) -> str:
    entries = []
    for index, line in enumerate(lines):
        kind = f"line c{index % 7}" + (" ours" if line.is_ours else "")
        sample = (
            '<svg class="sample" viewBox="0 0 34 10" aria-hidden="true">'
            f'<polyline class="{kind}" stroke-dasharray="{_DASHES[index % 7]}" points="1,5 33,5"/></svg>'
        )
        entries.append(f"<li>{sample}{escape(line.name)}</li>")
    return f'<ul class="legend">{"".join(entries)}</ul>'


def _ticks(values: Sequence[float]) -> list[float]:
    """Round numbers that enclose the values, at most _MOST_TICKS and two more."""
    low, high = min(values), max(values)
    if not (math.isfinite(low) and math.isfinite(high)):
        raise ValueError("a chart of values that are not finite")
    span = high - low or max(abs(high), 1.0)
    power = 10.0 ** math.floor(math.log10(span / _MOST_TICKS))
    step = next(power * factor for factor in (1, 2, 5, 10) if span / (power * factor) <= _MOST_TICKS)
    first, last = math.floor(low / step), math.ceil(high / step)
    last = max(last, first + 1)
    return [round(index * step, 12) for index in range(first, last + 1)]
