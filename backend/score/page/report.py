"""The whole page: what was asked, how well it was answered, beside what needs no answer at all."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from pathlib import Path
from typing import Any

from backend.io.atomic import write_text
from backend.reporting import Report
from backend.score.finished_job import FinishedJob, stage_seconds
from backend.score.page import cycles, markup, views, volumes
from backend.score.relight import RelightConfig
from backend.score.truth_set import Truth

_READING = (
    "Every picture is the smoke alone on black, sRGB-coded. PSNR has the peak 1 and counts at most 50 dB a frame; in smoke: over "
    "the true smoke and four pixels around it; global: of the mean squared error of all frames. On black much of a picture is "
    "easy, so a figure means nothing by itself: the answers beside ours need no reconstruction. copy, mirror: the input picture "
    "of the same moment as it is, or mirrored. billboard: the input picture on a plane through the smoke. still mean: our "
    "pictures' mean over time. frozen: of the last seen moment. black, grey: as they are called.",
    "SSIM: of Wang et al. 2004. LPIPS and ST-LPIPS: of Zhang et al. 2018 and Ghildyal and Liu 2022, over at most 8 frames of a "
    "view; lower is better. dtSSD: of Erofeev et al. 2015, how far the change from picture to picture is from the true one; "
    "lower is better, and what never moves has little to be blamed for. change: the size of our changes over that of the true "
    "ones; above 1 it flickers, below 1 it is too still. tOF: of Chu et al. 2020, the error of optical flow.",
    "The volume is compared on the voxels of the true one. Divergence: as published, one absolute regularisation, which makes "
    "sparse particles look incompressible; corrected, a relative one, over particles with at least eight neighbours.",
)


def write_report(
    path: Path,
    scores: Mapping[str, Any],
    job: FinishedJob,
    truth: Truth,
    *,
    relight: RelightConfig | None = None,
    report: Report,
) -> None:
    """One HTML file, whole or absent. scores: as scores_of gives them; relight: where the pictures of Cycles are kept."""
    title = f"{truth.name}: evaluation"
    shown = []
    total = len(truth.frames)
    for step, row in enumerate(views.picture_rows(job.prediction, truth, scores, job.anchor)):
        report.progress(step, total)
        shown.append(row)
    parts = [
        _header(scores, truth),
        markup.section("summary", "Summary", views.summary(scores), _not_measured(scores)),
        markup.section("curves", "Over angle, time and horizon", views.curves(scores, truth)),
        markup.section("pictures", "Pictures", _colours(), *shown),
        cycles.shown(scores, truth, job.folder.path, relight) if relight is not None else "",
        _volumes(scores, job, truth),
        markup.section("motion", "Motion", _motion(scores)),
        markup.section("views", "Every answer in every view", views.tables(scores)),
        markup.section("cost", "What it cost", _cost(stage_seconds(job))),
        markup.section("reading", "How to read this", *map(markup.paragraph, _READING)),
    ]
    write_text(path, markup.page(title, "\n".join(filter(None, parts))))
    report.progress(total, total)


def _header(scores: Mapping[str, Any], truth: Truth) -> str:
    job = scores["job"]
    counts = f"{truth.num_seen} frames at {truth.fps:g} a second were seen; {len(truth.frames)} views"
    made = f"{job['program']}, preset {job['preset']}, method {job['method']}"
    names = ("summary", "curves", "pictures", "relight", "volumes", "motion", "views", "cost", "reading")
    links = "".join(
        f'<li><a href="#{name}">{name}</a></li>'
        for name in names
        if name not in ("relight", "volumes") or scores.get(name.removesuffix("s"))
    )
    return (
        f'<header><h1>{escape(truth.name)}</h1><p class="soft">Reconstruction against the truth. {escape(made)}. '
        f'{escape(counts)}.</p><nav aria-label="Parts of this page"><ul>{links}</ul></nav></header>'
    )


def _colours() -> str:
    return markup.paragraph(
        "Difference: orange where ours is brighter than the truth, blue where it is darker; in full colour from a quarter of the "
        "whole range on. The last picture of a row is the best trivial answer of that view.",
        kind="soft",
    )


def _not_measured(scores: Mapping[str, Any]) -> str:
    missing = scores["not_measured"]
    if not missing:
        return ""
    lines = "".join(f"<li>{escape(name)}: {escape(reason)}</li>" for name, reason in missing.items())
    return f'<div class="note"><strong>Not measured</strong><ul>{lines}</ul></div>'


def _volumes(scores: Mapping[str, Any], job: FinishedJob, truth: Truth) -> str:
    if not scores["volume"]:
        return ""
    return markup.section(
        "volumes", "Volume and velocity", volumes.figures(scores), volumes.shown(job.prediction, job.proposals, truth)
    )


def _motion(scores: Mapping[str, Any]) -> str:
    rows = [
        [escape(views.title_of(view)), markup.number(found["tof"]), markup.number(found["still"])]
        for view, found in scores["motion"].items()
        if found
    ]
    flow = markup.table(
        ["view", "tOF of ours, px", "of what never moves, px"], rows, caption="Error of optical flow inside true smoke"
    )
    found = scores["divergence"]
    exported = scores.get("exported", {})
    rows = [
        ["the clip's opacity, dB inside smoke", markup.number(exported.get("particles_opacity_db"))],
        ["the same through the exported volumes, dB", markup.number(exported.get("opacity_db"))],
        ["mean |div v| as published, 1/s", markup.number(found.get("as_published"), 3)],
        ["the same corrected, 1/s", markup.number(found.get("corrected"), 3)],
        ["particles that the corrected one counts, %", markup.number(100.0 * found.get("coverage", 0.0), 1)],
        ["learned buoyancy, m/s&sup2;", markup.number(scores["buoyancy"].get("strength"), 3)],
        ["its direction off upwards, degrees", markup.number(scores["buoyancy"].get("degrees_from_up"), 1)],
        ["shading that the found sun explains, share", markup.number(scores["light"].get("explained"), 2)],
        ["doubt of the sun's direction, degrees", markup.number(scores["light"].get("doubt_degrees"), 0)],
    ]
    return flow + markup.table(["figure", "value"], rows, caption="Particles, means over the fitted frames")


def _cost(seconds: Mapping[str, float]) -> str:
    if not seconds:
        return markup.paragraph("The job does not know how long it took.")
    rows = [[escape(stage), markup.number(value, 1)] for stage, value in seconds.items()]
    rows.append(["all of them", markup.number(sum(seconds.values()), 1)])
    table = markup.table(
        ["stage", "seconds"], rows, caption="Wall-clock time of the job's last run, on whatever machine that was"
    )
    return table + markup.paragraph(
        "The job does not record its peak memory; benchmarks/reconstruction.py measures that.", kind="soft"
    )
