"""What the report shows of pictures: a summary, curves, a table and pictures for every view."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from html import escape
from typing import Any

import numpy as np

from backend.contract.truth import INPUT_VIEW
from backend.score import measures
from backend.score.compare import LOWER_IS_BETTER, OURS, best_trivial
from backend.score.evaluate import Prediction, Round, rounds_of
from backend.score.page import chart, markup, pictures
from backend.score.truth_set import Truth

FIGURES = {  # figure -> heading, digits
    "full_db": ("PSNR, dB", 2),
    "smoke_db": ("PSNR in smoke, dB", 2),
    "global_db": ("global PSNR, dB", 2),
    "first_db": ("first third, dB", 2),
    "middle_db": ("middle, dB", 2),
    "last_db": ("last, dB", 2),
    "ssim": ("SSIM", 3),
    "smoke_ssim": ("SSIM in smoke", 3),
    "lpips": ("LPIPS", 3),
    "st_lpips": ("ST-LPIPS", 3),
    "dtssd": ("dtSSD", 4),
    "change_ratio": ("change", 2),
}
SUMMARY = ("full_db", "smoke_db", "ssim", "lpips", "st_lpips", "dtssd")
_TITLES = {
    INPUT_VIEW: "Input view",
    "nvs": "First place (NVS)",
    "side": "Side",
    "back": "Back",
    "future_input": "Future, input view (FP IV)",
    "future_nvs": "Future, first place (FP NV)",
}
_CURVES = ("still mean", "copy", "mirror", "billboard")  # black and grey stand in the tables
_FROZEN = ("frozen reconstruction", "frozen copy", "frozen billboard", "still mean")
_SMALL_TURN = 2.0  # degrees; a view whose angle changes less is drawn over time

Answers = Mapping[str, Mapping[str, Any]]


def title_of(view: str) -> str:
    if view.startswith("future_"):
        return _TITLES.get(view, f"Future, {view.removeprefix('future_')}")
    return _TITLES.get(view, view.capitalize())


def views_of(scores: Mapping[str, Any]) -> dict[str, Answers]:
    """Those that are known by name first, futures after what was seen."""
    found = {name: value for name, value in scores.items() if name != "relight" and isinstance(value, dict) and OURS in value}
    known = list(_TITLES)
    order = sorted(found, key=lambda name: (name.startswith("future_"), known.index(name) if name in known else len(known)))
    return {name: found[name] for name in order}


def summary(scores: Mapping[str, Any]) -> str:
    """Ours beside the best trivial answer, a row for each view and figure that it has."""
    rows = []
    for view, answers in views_of(scores).items():
        for figure in SUMMARY:
            ours = answers[OURS].get(figure)
            if ours is None:
                continue
            heading, digits = FIGURES[figure]
            name, best = best_trivial(answers, figure)
            difference = markup.lead(ours - best, digits, is_lower_better=figure in LOWER_IS_BETTER)
            cells = [
                markup.number(ours, digits),
                markup.number(best, digits),
                f'<span class="text">{escape(name)}</span>',
                difference,
            ]
            rows.append([title_of(view) if figure == SUMMARY[0] else "", f'<span class="text">{heading}</span>', *cells])
    headings = [
        "view",
        '<span class="text">figure</span>',
        "ours",
        "best trivial answer",
        '<span class="text">which</span>',
        "difference",
    ]
    caption = "Means over the frames of a view. An arrow up is better than every answer that needs no reconstruction."
    return markup.table(headings, rows, caption=caption)


def curves(scores: Mapping[str, Any], truth: Truth) -> str:
    """PSNR over the angle to the input camera where that changes, else over time; of a future over its horizon."""
    charts = []
    for view, answers in views_of(scores).items():
        is_future = view.startswith("future_")
        angles = scores["by_frame_angle"].get(view, {})
        spread = max(angles.values(), default=0.0) - min(angles.values(), default=0.0)
        if is_future:
            label = "horizon, s"
            places = {frame: (int(frame) - truth.num_seen + 1) / truth.fps for frame in answers[OURS]["by_frame_db"]}
        elif spread > _SMALL_TURN and _is_one_way(angles, answers):
            label, places = "angle between the view and the input camera, degrees", angles
        else:
            label = "time, s"
            places = {frame: int(frame) / truth.fps for frame in answers[OURS]["by_frame_db"]}
        names = [OURS, *(name for name in (_FROZEN if is_future else _CURVES) if name in answers)]
        charts.append(_curve(view, answers, names, places, label))
    return f'<div class="charts">{"".join(charts)}</div>'


def _is_one_way(angles: Mapping[str, float], answers: Answers) -> bool:
    """Whether an angle belongs to one frame only."""
    shown = [angles[frame] for frame in answers[OURS]["by_frame_db"]]
    steps = [after - before for before, after in itertools.pairwise(shown)]
    return all(step > 0.0 for step in steps) or all(step < 0.0 for step in steps)


def _curve(view: str, answers: Answers, names: list[str], places: Mapping[str, float], label: str) -> str:
    lines = [
        chart.Line(
            name=name,
            points=sorted((places[frame], value) for frame, value in answers[name]["by_frame_db"].items()),
            is_ours=name == OURS,
        )
        for name in names
    ]
    title = f"{title_of(view)}: PSNR of each frame over {label}"
    svg = chart.drawn(chart.Chart(title=title, x_label=label, y_label="PSNR, dB", lines=lines))
    if not svg:
        return ""
    rows = [
        [markup.number(x), *(markup.number(answers[name]["by_frame_db"][frame]) for name in names)] for frame, x in places.items()
        if frame in answers[OURS]["by_frame_db"]
    ]  # fmt: skip
    table = markup.table([escape(label), *map(escape, names)], rows, caption=title)
    return f"<figure><h3>{escape(title_of(view))}</h3>{svg}<details><summary>The figures</summary>{table}</details></figure>"


def tables(scores: Mapping[str, Any]) -> str:
    """Every answer in every view; the best of a column is underlined."""
    parts = []
    for view, answers in views_of(scores).items():
        figures = [figure for figure in FIGURES if any(found.get(figure) is not None for found in answers.values())]
        best = {figure: _best(answers, figure) for figure in figures}
        rows = []
        for name, found in answers.items():
            cells = []
            for figure in figures:
                text = markup.number(found.get(figure), FIGURES[figure][1])
                is_best = found.get(figure) is not None and found[figure] == best[figure]
                cells.append(f'<span class="best">{text}</span>' if is_best else text)
            rows.append([escape(name), *cells])
        headings = ["answer", *(FIGURES[figure][0] for figure in figures)]
        parts.append(markup.table(headings, rows, caption=title_of(view), ours=OURS))
    return "".join(parts)


def _best(answers: Answers, figure: str) -> float | None:
    """None where no figure is better than another one: of changes the truth's own is 1."""
    values = [found[figure] for found in answers.values() if found.get(figure) is not None]
    if figure == "change_ratio":
        return min(values, key=lambda value: abs(np.log(max(value, 1e-6))), default=None)
    return (min if figure in LOWER_IS_BETTER else max)(values, default=None)


def picture_rows(prediction: Prediction, truth: Truth, scores: Mapping[str, Any], anchor: np.ndarray) -> Iterator[str]:
    """Truth, ours, their difference and the best trivial answer, at a few moments of every view."""
    seen = truth.pictures(INPUT_VIEW)
    for view in [view for view in views_of(scores) if view in truth.frames]:
        shown = seen if view == INPUT_VIEW else truth.pictures(view)
        rows = []
        for part in rounds_of(prediction, truth, view, seen, anchor):
            answers = views_of(scores)[part.name]
            for frame in _moments(part):
                real = measures.coded(shown[truth.frames[view].index(frame)])
                rows.append(_row(part, answers, frame, real, truth))
        place = truth.view(view, truth.frames[view][0])
        kind = "moments tall" if place.height > place.width else "moments"
        yield f'<h3>{escape(title_of(view))}</h3><div class="{kind}">{"".join(rows)}</div>'


def _moments(part: Round) -> list[int]:
    """First, middle and last; of a future only the last."""
    last = len(part.frames) - 1
    places = sorted({0, last // 2, last}) if part.num_seen else [last]
    return [part.frames[place] for place in places]


def _row(part: Round, answers: Answers, frame: int, real: np.ndarray, truth: Truth) -> str:
    name, _ = best_trivial(answers, "full_db")
    ours = measures.coded(part.answers[OURS](frame))
    trivial = measures.coded(part.answers[name](frame))
    where = f"{title_of(part.name)}, frame {frame}"
    by_frame = {answer: answers[answer]["by_frame_db"][str(frame)] for answer in (OURS, name)}
    caption = f"Frame {frame}, {frame / truth.fps:.2f} s" + ("" if part.num_seen else ", forecast")
    return markup.tiles(
        [
            (pictures.inline(real), f"{where}: truth", "truth"),
            (pictures.inline(ours), f"{where}: reconstruction", f"ours, {by_frame[OURS]:.1f} dB"),
            (pictures.inline(pictures.difference(ours, real)), f"{where}: difference", "difference"),
            (pictures.inline(trivial), f"{where}: {name}", f"{name}, {by_frame[name]:.1f} dB"),
        ],
        caption=caption,
    )
