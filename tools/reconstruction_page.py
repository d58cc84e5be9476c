"""The part of docs/results.md on the reconstruction, from what benchmarks.reconstruction wrote. Nothing in it is typed by hand
but what is to be reached."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from backend.contract.job import METHODS, PRESETS
from backend.score.compare import OURS, lead

Cell = dict[str, Any]
Cells = Mapping[tuple[str, str], list[Cell]]  # by preset and method
Figure = Callable[[Cell], float | None]  # None where a cell has none
FINAL = "final", "default"  # whose figures are to be reached
PER_FRAME = "per_frame"  # of a cell's scores: what benchmarks.per_frame says of its scene

PICTURES = {
    "reconstruction_middle.jpg": "Truth and reconstruction side by side in every view, in the middle of the clip:",
    "reconstruction_last.jpg": "The same at its end, where the input camera is furthest from the first place:",
    "reconstruction_methods.jpg": "Every method from the side, at the end of the clip:",
    "reconstruction_angle.png": "Error over the angle between the input camera and the first place:",
    "reconstruction_horizon.png": "Error over the horizon of the forecast:",
}


def of_view(view: str, figure: str) -> Figure:
    return lambda cell: cell["scores"].get(view, {}).get(OURS, {}).get(figure)


def lead_of(view: str, figure: str = "full_db", *, kind: str = "") -> Figure:
    """dB over the best trivial answer of the same scene."""
    return lambda cell: lead(cell["scores"][view], figure, kind=kind) if view in cell["scores"] else None


def of_volume(figure: str, *, volume: str = "volume") -> Figure:
    return lambda cell: cell["scores"].get(volume, {}).get(figure)


def of_velocity(figure: str) -> Figure:
    return lambda cell: cell["scores"]["volume"].get("velocity", {}).get(figure)


def of_divergence(figure: str) -> Figure:
    return lambda cell: cell["scores"]["divergence"].get(figure)


def of_cost(figure: str) -> Figure:
    """None of a job that was interrupted: what its last run took is not what it takes."""
    return lambda cell: None if cell["cost"]["is_resumed"] else cell["cost"][figure]


def mass_error(cell: Cell) -> float | None:
    ratio = cell["scores"]["volume"].get("mass_ratio")
    return None if ratio is None else abs(ratio - 1.0)


VIEW_COLUMNS: dict[str, tuple[Figure, str]] = {
    "input, smoke": (of_view("input", "smoke_db"), ".2f"),
    "input": (of_view("input", "full_db"), ".2f"),
    "NVS first third": (of_view("nvs", "first_db"), ".2f"),
    "middle": (of_view("nvs", "middle_db"), ".2f"),
    "last": (of_view("nvs", "last_db"), ".2f"),
    "NVS": (of_view("nvs", "full_db"), ".2f"),
    "NVS, global": (of_view("nvs", "global_db"), ".2f"),
    "side": (of_view("side", "full_db"), ".2f"),
    "side, global": (of_view("side", "global_db"), ".2f"),
    "back": (of_view("back", "full_db"), ".2f"),
    "FP (IV)": (of_view("future_input", "full_db"), ".2f"),
    "FP (NV)": (of_view("future_nvs", "full_db"), ".2f"),
}
VOLUME_COLUMNS: dict[str, tuple[Figure, str]] = {
    "density": (of_volume("correlation"), ".3f"),
    "of the volumes followed": (of_volume("correlation", volume="prior_volume"), ".3f"),
    "relative L2": (of_volume("relative_l2"), ".3f"),
    "mass": (of_volume("mass_ratio"), ".3f"),
    "opacity, dB": (of_volume("particles_opacity_db", volume="exported"), ".2f"),
    "in the VDB": (of_volume("opacity_db", volume="exported"), ".2f"),
    "sideways": (of_velocity("correlation_sideways"), ".2f"),
    "up": (of_velocity("correlation_up"), ".2f"),
    "depth": (of_velocity("correlation_depth"), ".2f"),
    "div as published": (of_divergence("as_published"), ".2f"),
    "div corrected": (of_divergence("corrected"), ".2f"),
    "buoyancy off up, degrees": (lambda cell: cell["scores"]["buoyancy"].get("degrees_from_up"), ".0f"),
    "sun off, degrees": (lambda cell: cell["scores"].get("light", {}).get("degrees_from_sun"), ".0f"),
    "seconds": (of_cost("seconds"), ".0f"),
    "processor s": (of_cost("cpu_seconds"), ".0f"),
    "peak GiB": (of_cost("peak_gib"), ".2f"),
}


def mean(cells: list[Cell], figure: Figure) -> float | None:
    found = [value for cell in cells if (value := figure(cell)) is not None]
    return sum(found) / len(found) if found else None


def shown(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)


class Target(NamedTuple):
    """A figure that is to be reached; value: None where it was not measured."""

    title: str
    value: float | None
    form: str
    limit: float
    is_least: bool = True  # else it is the most that is allowed

    @property
    def verdict(self) -> str:
        if self.value is None:
            return "not measured"
        is_reached = self.value >= self.limit if self.is_least else self.value <= self.limit
        return "yes" if is_reached else "no"

    @property
    def words(self) -> str:
        return f"at {'least' if self.is_least else 'most'} {self.limit:g}"


def targets(every: Cells) -> Iterator[Target]:
    """Means over the scenes of the default method at `final`, but where a title says otherwise."""
    cells = every[FINAL]

    def least(title: str, figure: Figure, limit: float, form: str = ".2f") -> Target:
        return Target(title, mean(cells, figure), form, limit)

    yield least("input view, smoke mask, dB", of_view("input", "smoke_db"), 32.0)
    yield least("NVS, first third, dB over the best trivial answer", lead_of("nvs", "first_db"), 0.0, "+.2f")
    yield least("NVS, last third, dB over the best trivial answer", lead_of("nvs", "last_db"), 1.5, "+.2f")
    yield least("NVS, all of it, dB", of_view("nvs", "full_db"), 29.78)
    yield least("side, dB over the best trivial answer", lead_of("side"), 2.5, "+.2f")
    yield least("density correlation", of_volume("correlation"), 0.78, ".3f")
    gains = [gain for cell in cells if (gain := over_cross_section(cell)) is not None]
    yield Target("density correlation over that of the per-frame prior, worst scene", min(gains, default=None), "+.3f", 0.0)
    yield Target("error of the total mass", mean(cells, mass_error), ".3f", 0.1, is_least=False)
    for name, limit in (("sideways", 0.55), ("up", 0.65), ("depth", 0.3)):
        yield least(f"velocity correlation, {name}", of_velocity(f"correlation_{name}"), limit)
    yield least("FP (IV), dB over freezing", lead_of("future_input", kind="frozen"), 2.0, "+.2f")
    yield least("FP (IV), dB", of_view("future_input", "full_db"), 25.26)
    yield least("FP (NV), dB over the best trivial answer", lead_of("future_nvs"), 0.5, "+.2f")
    yield least("FP (NV), dB", of_view("future_nvs", "full_db"), 25.04)
    yield Target("mean abs(div v) as published, 1/s", mean(cells, of_divergence("as_published")), ".2f", 0.74, is_least=False)
    published = mean(every.get(("final", "as_published"), []), of_divergence("corrected"))
    if published is not None:
        title = "mean abs(div v) corrected, 1/s, against that of `as_published`"
        yield Target(title, mean(cells, of_divergence("corrected")), ".2f", round(published, 2), is_least=False)
    for preset, limit in (("draft", 60.0), ("preview", 300.0), ("final", 1200.0)):
        seconds = mean(every.get((preset, "default"), []), of_cost("seconds"))
        yield Target(f"{preset}, seconds", seconds, ".0f", limit, is_least=False)
    peaks = [value for cell in cells if (value := of_cost("peak_gib")(cell)) is not None]
    yield Target("peak memory, GiB, largest", max(peaks, default=None), ".2f", 3.0, is_least=False)


def reached(every: Cells) -> str:
    """The targets, with what the scenes that nothing was tuned on say alone."""
    untouched = {key: found for key, cells in every.items() if (found := [cell for cell in cells if cell["untouched"]])}
    alone = {target.title: target for target in targets(untouched)} if FINAL in untouched else {}
    rows = [
        [
            target.title,
            target.words,
            shown(target.value, target.form),
            shown(alone[target.title].value, target.form) if target.title in alone else "-",
            target.verdict,
        ]
        for target in targets(every)
    ]
    return table(["figure", "target", "all", "untouched", "reached"], rows)


def over_cross_section(cell: Cell) -> float | None:
    ours, prior = of_volume("correlation")(cell), of_volume("cross-section", volume=PER_FRAME)(cell)
    return None if ours is None or prior is None else ours - prior


def with_per_frame(cell: Cell, per_frame: dict[str, Any]) -> Cell:
    """A cell with what benchmarks.per_frame says of its scene, where that was measured with the same weights."""
    is_same = cell["weights"] is not None and cell["weights"].startswith(per_frame["weights"])
    own = per_frame["scenes"].get(cell["scene"], {}) if is_same else {}
    return {**cell, "scores": {**cell["scores"], PER_FRAME: own}}


def by_frame(cells: list[Cell]) -> list[str]:
    """What knows single frames, beside what knows the clip."""
    columns = {
        "cross-section": of_volume("cross-section", volume=PER_FRAME),
        "the network's own word": of_volume("network", volume=PER_FRAME),
        "volumes followed": of_volume("correlation", volume="prior_volume"),
        "particles": of_volume("correlation"),
    }
    rows = [[marked(cell), *(shown(figure(cell), ".3f") for figure in columns.values())] for cell in cells]
    return [
        "### Beside densities of single frames\n",
        "Density correlation. `python -m benchmarks.per_frame --jobs DIR/final/default --json docs/results/per_frame.json`: the "
        "cross-section is the per-frame prior that is to be bettered, row A of the prototype that this project started from; the "
        "large network sees the frames around one, too, and is asked anew about each. The volumes that the particles follow "
        "hold what the whole clip says.\n",
        table(["scene", *columns], rows),
    ]


def reconstruction(figures: dict[str, Any], images: Path, per_frame: dict[str, Any] | None = None) -> list[str]:
    """The section's parts. images: the folder of the pictures, of which those that are there are shown; per_frame: what
    benchmarks.per_frame wrote."""
    every: dict[tuple[str, str], list[Cell]] = {}
    for cell in sorted(figures["cells"], key=lambda cell: cell["scene"]):
        every.setdefault((cell["preset"], cell["method"]), []).append(cell)
    every = {key: every[key] for key in ((p, m) for p in PRESETS for m in METHODS) if key in every}
    if per_frame is not None and FINAL in every:
        every[FINAL] = [with_per_frame(cell, per_frame) for cell in every[FINAL]]
    parts = ["## Reconstruction\n", how(figures)]
    if FINAL in every:
        parts += [
            f"What is to be reached and what is, by the default method at `final`: {over_scenes(every[FINAL])}.\n",
            reached(every),
        ]
    for name, text in PICTURES.items():
        if (images / name).is_file():
            parts += [f"{text}\n", f"![{text.rstrip(':')}](images/{name})\n"]
    best = max((key for key in every if key[1] == METHODS[0]), key=lambda key: PRESETS.index(key[0]), default=None)
    if best is not None:
        parts += ["### Beside trivial answers\n", *trivial(best, every[best])]
    if per_frame is not None and FINAL in every:
        parts += by_frame(every[FINAL])
    parts += ["### Presets and methods\n", "Means over the scenes; what more seconds buy.\n"]
    parts += [means(every, columns) for columns in (VIEW_COLUMNS, VOLUME_COLUMNS)]
    parts += ["Seconds by stage:\n", stages(every)]
    parts += ["### Every scene\n", *(scenes(every, columns) for columns in (VIEW_COLUMNS, VOLUME_COLUMNS))]
    return parts


def how(figures: dict[str, Any]) -> str:
    """By which command, on which machine, with what."""
    machine, cells = figures["machine"], figures["cells"]
    threads = " or ".join(sorted({str(cell["cost"]["threads"]) for cell in cells}))
    loads = [cell["cost"]["load"] for cell in cells]
    weights = sorted({cell["weights"][:12] for cell in cells if cell["weights"]})
    codes: dict[str, set[str]] = {}
    for cell in cells:
        codes.setdefault(cell["code"], set()).add(cell["method"])
    if len(codes) > 1:
        made = " and ".join(f"{code} ({', '.join(sorted(methods))})" for code, methods in sorted(codes.items()))
        made += ", measured in different runs: seconds of one are not to be held against those of another"
    else:
        made = "".join(codes)
    versions = ", ".join(f"{name} {number}" for name, number in figures["versions"].items())
    return (
        "`python -m benchmarks.reconstruction --out DIR --page`. Fitted from smoke on black with the true cameras; "
        "PSNR in dB of sRGB on black over the full frame, of single frames at most 50 (`global`: of the mean squared error of "
        "all of them); volumes and velocities inside true smoke. Nothing was tuned on scenes with *. "
        f"Machine: {machine['processor']}, {machine['cores']} cores, {machine['memory_gib']:.0f} GiB, {machine['system']}; "
        f"{threads} threads, load average {min(loads):.1f} to {max(loads):.1f} at the starts. {versions}. "
        f"{'Weights of the prior' if weights else 'No weights of a prior'} {' and '.join(weights)}".rstrip()
        + f"; sources {made}. Settings of each preset and method: `settings` in the file.\n"
    )


def over_scenes(cells: list[Cell]) -> str:
    return f"mean over {len(cells)} scenes" if len(cells) > 1 else f"the scene {cells[0]['scene']}"


def marked(cell: Cell) -> str:
    return cell["scene"] + ("*" if cell["untouched"] else "")


def trivial(key: tuple[str, str], cells: list[Cell]) -> list[str]:
    """A table of views that were never seen, one of the future; the best of a line is bold."""
    parts = [f"Method `{key[1]}`, preset `{key[0]}`, dB over the full frame; the best of a line is bold.\n"]
    for views in ({"nvs": "NVS", "side": "side", "back": "back"}, {"future_input": "FP (IV)", "future_nvs": "FP (NV)"}):
        there = [(cell, view) for view in views for cell in cells if view in cell["scores"]]
        if not there:
            continue
        answers = list(there[0][0]["scores"][there[0][1]])
        rows = []
        for cell, view in there:
            found = {answer: cell["scores"][view][answer]["full_db"] for answer in answers}
            most = max(found.values())
            rows.append([views[view], marked(cell), *(f"**{v:.2f}**" if v == most else f"{v:.2f}" for v in found.values())])
        parts.append(table(["view", "scene", *answers], rows))
    return parts


def means(every: Cells, columns: Mapping[str, tuple[Figure, str]]) -> str:
    rows = [
        [preset, method, str(len(cells)), *(shown(mean(cells, figure), form) for figure, form in columns.values())]
        for (preset, method), cells in every.items()
    ]
    return table(["preset", "method", "scenes", *columns], rows)


def scenes(every: Cells, columns: Mapping[str, tuple[Figure, str]]) -> str:
    rows = [
        [preset, method, marked(cell), *(shown(figure(cell), form) for figure, form in columns.values())]
        for (preset, method), cells in every.items()
        for cell in cells
    ]
    return table(["preset", "method", "scene", *columns], rows)


def stages(every: Cells) -> str:
    """Means over the scenes whose jobs ran through."""
    whole = {key: [cell for cell in cells if not cell["cost"]["is_resumed"]] for key, cells in every.items()}
    names = list(dict.fromkeys(name for cells in whole.values() for cell in cells for name in cell["cost"]["stages"]))
    rows = [
        [*key, *(shown(mean(cells, lambda cell, name=name: cell["cost"]["stages"].get(name)), ".1f") for name in names)]
        for key, cells in whole.items()
    ]
    return table(["preset", "method", *names], rows)


def table(head: list[str], rows: list[list[str]]) -> str:
    """In Markdown."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"
