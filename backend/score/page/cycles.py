"""What the report shows of Cycles: figures and pictures of the exported volumes."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from pathlib import Path
from typing import Any

from backend.score.compare import OURS
from backend.score.page import markup, pictures
from backend.score.page.views import FIGURES
from backend.score.relight import RelightConfig, kept_pictures
from backend.score.truth_set import Truth

_SHOWN = ("full_db", "smoke_db", "ssim", "smoke_ssim")


def shown(scores: Mapping[str, Any], truth: Truth, job: Path, config: RelightConfig) -> str:
    """A section of the page. scores: with what relight_scores found."""
    by, found = scores["relight_by"], scores["relight"]
    words = (
        f"The exported VDB sequence as the add-on imports it, drawn by Cycles of {by['program']} from the input camera at "
        f"{by['width']} x {by['height']} px with {by['samples']} samples a pixel, denoised, as filmed: without light of its own. "
        "The particles are what this program draws of the same frames; the difference is what voxels and path tracing change."
    )
    answers = {"ours, Cycles": found[OURS], "ours, particles": scores["relight_particles"]}
    answers |= {name: found[name] for name in ("black", "grey")}
    figures = [figure for figure in _SHOWN if found[OURS].get(figure) is not None]
    rows = [[escape(name), *(_cell(answer, figure) for figure in figures)] for name, answer in answers.items()]
    headings = ["answer", *(FIGURES[figure][0] for figure in figures)]
    table = markup.table(headings, rows, caption="Means over the frames that were drawn", ours="ours, Cycles")
    by_frame = found[OURS]["by_frame_db"]
    moments = []
    for frame, layer, real in kept_pictures(job, truth, by_frame, config):
        told = f"Input view, frame {frame}"
        tiles = [
            (pictures.inline(real), f"{told}: truth", "truth"),
            (pictures.inline(layer), f"{told}: drawn by Cycles", f"Cycles, {by_frame[str(frame)]:.1f} dB"),
            (pictures.inline(pictures.difference(layer, real)), f"{told}: difference", "difference"),
        ]
        moments.append(markup.tiles(tiles, caption=f"Frame {frame}, {frame / truth.fps:.2f} s"))
    kind = "moments tall" if by["height"] > by["width"] else "moments"
    row = f'<div class="{kind}">{"".join(moments)}</div>'
    return markup.section("relight", "As Cycles shows it", markup.paragraph(words), table, row)


def _cell(answer: Mapping[str, Any], figure: str) -> str:
    return markup.number(answer[figure], FIGURES[figure][1])
