"""What `bench` found, compared: noise, the Pareto front, presets that something else beats, and how cost grows.

Costs are processor seconds: they depend least on what else the machine does. Accuracy is four measures, because settings buy
different ones: how well views are told that were never seen (the mean of NVS and side: what three dimensions are for), how
well the clip itself is reproduced by the particles and by the exported volumes, and whether the smoke is where it is (density
correlation). The first is the one number where one is wanted.

Standard library only, so that pages and tests may read it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

Cell = Mapping[str, Any]

MEASURES = ("unseen_db", "input_smoke_db", "vdb_opacity_db", "density_correlation")
COST = "log_cost"
# Differences that nobody would choose a setting for, whatever the noise: 0.1 dB is what a part may cost that is left out.
SMALLEST = {"unseen_db": 0.1, "input_smoke_db": 0.1, "vdb_opacity_db": 0.1, "density_correlation": 0.005, COST: math.log(1.05)}
DEVIATIONS = 2.0  # standard errors that count as noise


def totals(stages: Mapping[str, Mapping[str, float]]) -> dict[str, float]:
    """Seconds, processor seconds and peak memory, GiB, of a job. Without its inspection: most of that is the timing of the
    machine for the estimate, which a machine goes through once and keeps."""
    counted = [stage for name, stage in stages.items() if name != "inspect"]
    found = {key: round(sum(stage[key] for stage in counted), 3) for key in ("seconds", "cpu_seconds")}
    return {**found, "peak_gib": max(stage["peak_gib"] for stage in stages.values())}


def figures(cell: Cell) -> dict[str, float]:
    """The measures of a cell, and the logarithm of its cost."""
    scores = cell["scores"]
    return {
        "unseen_db": 0.5 * (scores["nvs_db"] + scores["side_db"]),
        "input_smoke_db": scores["input_smoke_db"],
        "vdb_opacity_db": scores["vdb_opacity_db"],
        "density_correlation": scores["density_correlation"],
        COST: math.log(cell["cpu_seconds"]),
    }


def noise_of(cells: Iterable[Cell]) -> dict[str, float]:
    """Standard deviation of each figure between runs that differ in their random numbers alone, pooled over settings and
    scenes. Raises ValueError where nothing was repeated."""
    groups: dict[tuple[str, str], list[dict[str, float]]] = {}
    for cell in cells:
        if not cell["changes"] and not cell["repeat"] and cell["threads"] == 1:
            name = f"{cell['preset']} {cell['frames']} {cell['scored_from']}"
            groups.setdefault((cell["scene"], name), []).append(figures(cell))
    repeated = [group for group in groups.values() if len(group) > 1]
    if not repeated:
        raise ValueError("nothing was measured twice: how much is noise is not known")
    freedom = sum(len(group) - 1 for group in repeated)
    found = {}
    for name in (*MEASURES, COST):
        means = [sum(row[name] for row in group) / len(group) for group in repeated]
        squares = sum((row[name] - mean) ** 2 for group, mean in zip(repeated, means, strict=True) for row in group)
        found[name] = math.sqrt(squares / freedom)
    return found


@dataclass(frozen=True, slots=True, kw_only=True)
class Point:
    """A trial: its cells by scene."""

    name: str
    cells: Mapping[str, Cell]

    def mean(self, figure: str, scenes: Iterable[str] | None = None) -> float:
        """Over scenes; all of its own by default. Costs are averaged as logarithms: every scene's ratio counts alike."""
        rows = [figures(self.cells[scene]) for scene in scenes or self.cells]
        return sum(row[figure] for row in rows) / len(rows)

    @property
    def cost(self) -> float:
        """Processor seconds, the geometric mean over scenes."""
        return math.exp(self.mean(COST))


def points_of(cells: Iterable[Cell], *, frames: Sequence[int]) -> dict[str, Point]:
    """Trials that may be compared: the same frames scored, one thread, the first random numbers."""
    found: dict[str, dict[str, Cell]] = {}
    for cell in cells:
        is_alike = cell["frames"] == list(frames) and cell["scored_from"] == frames[0]
        if is_alike and cell["threads"] == 1 and not cell["seed"] and not cell["repeat"]:
            found.setdefault(cell["name"], {})[cell["scene"]] = cell
    return {name: Point(name=name, cells=by_scene) for name, by_scene in found.items()}


def gains(point: Point, other: Point, noise: Mapping[str, float]) -> dict[str, float]:
    """By how much `point` is better than `other` in each figure, in units of what counts as a difference: means over the
    scenes that both have, pair by pair. Cheaper is better."""
    scenes = sorted(point.cells.keys() & other.cells.keys())
    found = {}
    for name in (*MEASURES, COST):
        margin = max(SMALLEST[name], DEVIATIONS * noise[name] * math.sqrt(2.0 / len(scenes))) if scenes else math.inf
        gain = (point.mean(name, scenes) - other.mean(name, scenes)) / margin if scenes else 0.0
        found[name] = -gain if name == COST else gain
    return found


def dominates(point: Point, other: Point, noise: Mapping[str, float]) -> bool:
    """Whether `point` is nowhere worse than `other` and somewhere better, both by more than noise."""
    found = gains(point, other, noise).values()
    return min(found) >= -1.0 and max(found) > 1.0


def dominating(point: Point, others: Iterable[Point], noise: Mapping[str, float]) -> list[Point]:
    """Those that dominate a point on all of its scenes, the cheapest first."""
    found = [other for other in others if other.cells.keys() >= point.cells.keys() and dominates(other, point, noise)]
    return sorted(found, key=lambda other: other.cost)


def front(points: Iterable[Point], measure: str) -> list[Point]:
    """Those that nothing cheaper reaches in a measure, by cost. All must have the same scenes."""
    found: list[Point] = []
    for point in sorted(points, key=lambda point: (point.cost, -point.mean(measure))):
        if not found or point.mean(measure) > found[-1].mean(measure):
            found.append(point)
    return found


@dataclass(frozen=True, slots=True, kw_only=True)
class Growth:
    """cost ~ value ** exponent; error: its standard error; count: measurements."""

    exponent: float
    error: float
    count: int


def growth(rows: Iterable[tuple[str, float, float]]) -> Growth | None:
    """Least squares of log cost over log value, from (scene, value, cost), each scene with a factor of its own. None where
    there are too few; values and costs of 0 say nothing."""
    groups: dict[str, list[tuple[float, float]]] = {}
    for scene, value, cost in rows:
        if value > 0.0 and cost > 0.0:
            groups.setdefault(scene, []).append((math.log(value), math.log(cost)))
    groups = {scene: group for scene, group in groups.items() if len(group) > 1}
    centred = []
    for group in groups.values():
        x_mean, y_mean = (sum(column) / len(group) for column in zip(*group, strict=True))
        centred += [(x - x_mean, y - y_mean) for x, y in group]
    freedom = len(centred) - len(groups) - 1
    spread = sum(x * x for x, _ in centred)
    if freedom < 1 or spread <= 0.0:
        return None
    exponent = sum(x * y for x, y in centred) / spread
    residual = sum((y - exponent * x) ** 2 for x, y in centred)
    return Growth(exponent=exponent, error=math.sqrt(residual / freedom / spread), count=len(centred))


def growth_of(sweep: Mapping[str, Any], cells: Iterable[Cell], stage: str = "") -> Growth | None:
    """How the processor seconds of a stage, of the whole job by default, grow with the setting of a sweep."""
    values = {name: float(value) for value, name in sweep["points"]}
    rows = []
    for cell in cells:
        if cell["name"] in values:
            cost = cell["stages"].get(stage, {}).get("cpu_seconds", 0.0) if stage else cell["cpu_seconds"]
            rows.append((cell["scene"], values[cell["name"]], cost))
    return growth(rows)
