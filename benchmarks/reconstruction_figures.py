"""Pictures of what benchmarks.reconstruction left in a folder, for docs/results.md.

    python -m benchmarks.reconstruction_figures DIR --out docs/images [--preset final] [--from synthetic/bench]

    reconstruction_middle.jpg, reconstruction_last.jpg   a row for each scene; truth and reconstruction in every view, at the
                                                         middle and at the last moment that all views were rendered at
    reconstruction_methods.jpg                           the side view at the last moment by every method
    reconstruction_angle.png                             PSNR over the angle between the input camera and the novel one
    reconstruction_horizon.png                           PSNR of the forecast over its horizon

A picture that there is nothing to show of is not made. --preset: the best that is there without it.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from backend.contract.job import METHODS, PRESETS
from backend.contract.result import PARTICLES_FILE
from backend.contract.truth import INPUT_VIEW
from backend.io.atomic import whole_file
from backend.io.particles import read_particles
from backend.score.measures import coded
from backend.score.particles import ParticlePrediction
from backend.score.truth_set import TruthSet, read_truth_set
from backend.score.volumes import camera_axes
from benchmarks.reconstruction import RESULTS_FILE, SETS, UNTOUCHED
from tools.contact_sheet import beside

VIEWS = {INPUT_VIEW: "input", "nvs": "first place", "side": "side", "back": "back"}
_LARGEST = 240  # px, of the longer side of a picture on a sheet
_QUALITY = 88  # of JPEG
_STYLES = {
    "ours": {"color": "tab:blue", "linewidth": 2.0},
    "as_published": {"color": "tab:green"},
    "fluidnexus": {"color": "tab:olive"},
    "copy": {"color": "0.45", "linestyle": "--"},
    "billboard": {"color": "0.45", "linestyle": ":"},
    "frozen reconstruction": {"color": "tab:red", "linestyle": "--"},
    "frozen copy": {"color": "0.45", "linestyle": "--"},
}


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--preset", choices=PRESETS)
    parser.add_argument("--from", dest="source", type=Path, default=SETS)
    given = parser.parse_args(arguments)
    cells = json.loads((given.folder / RESULTS_FILE).read_text(encoding="utf-8"))["cells"]
    preset = given.preset or max((cell["preset"] for cell in cells), key=PRESETS.index)
    cells = [cell for cell in cells if cell["preset"] == preset]
    truths = {name: read_truth_set(given.source / name) for name in sorted({cell["scene"] for cell in cells})}
    for name, sheet in sheets(given.folder, cells, truths):
        with whole_file(given.out / name) as part:
            part.write_bytes(cv2.imencode(".jpg", sheet, (cv2.IMWRITE_JPEG_QUALITY, _QUALITY))[1].tobytes())
    for name, figure in (("angle", over_angle(cells, truths)), ("horizon", over_horizon(cells, truths))):
        with whole_file(given.out / f"reconstruction_{name}.png") as part:
            figure.savefig(part, format="png", dpi=90, bbox_inches="tight")
        plt.close(figure)
    return 0


def sheets(folder: Path, cells: list[dict[str, Any]], truths: dict[str, TruthSet]) -> Iterator[tuple[str, np.ndarray]]:
    """File names and pictures [H, W, 3] uint8 BGR."""
    rows: dict[str, list[np.ndarray]] = {"middle": [], "last": [], "methods": []}
    for scene, truth in truths.items():
        jobs = {cell["method"]: folder / cell["preset"] / cell["method"] / scene for cell in cells if cell["scene"] == scene}
        jobs = {method: jobs[method] for method in METHODS if method in jobs}
        moments = shown_moments(truth)
        first = next(iter(jobs))
        for place, frame in moments.items():
            pictures = [half for view in VIEWS for half in pair(truth, jobs[first], view, frame, titles(first))]
            rows[place].append(beside(pictures, f"{named(scene)}, frame {frame}"))
        last = moments["last"]
        pictures = [labelled(of_truth(truth, "side", last), "truth, side")]
        pictures += [labelled(of_job(job, truth, "side", last), titles(method)) for method, job in jobs.items()]
        rows["methods"].append(beside(pictures, f"{named(scene)}, frame {last}"))
    for place, found in rows.items():
        if place != "methods" or len({cell["method"] for cell in cells}) > 1:
            yield f"reconstruction_{place}.jpg", stacked(found)


def titles(method: str) -> str:
    return "ours" if method == "default" else method


def named(scene: str) -> str:
    return f"{scene} (untouched)" if scene in UNTOUCHED else scene


def pair(truth: TruthSet, job: Path, view: str, frame: int, title: str) -> list[np.ndarray]:
    """What a view shows in truth, and in the reconstruction."""
    shown = {"truth": of_truth(truth, view, frame), title: of_job(job, truth, view, frame)}
    return [labelled(picture, f"{VIEWS[view]}: {name}") for name, picture in shown.items()]


def labelled(picture: np.ndarray, text: str) -> np.ndarray:
    """With its edge, which smoke on black does not show, and a word on what it is. Changes the picture."""
    cv2.rectangle(picture, (0, 0), (picture.shape[1] - 1, picture.shape[0] - 1), (70, 70, 70), 1)
    cv2.putText(picture, text, (5, picture.shape[0] - 7), cv2.FONT_HERSHEY_SIMPLEX, 0.36, (200, 200, 200), 1, cv2.LINE_AA)
    return picture


def stacked(rows: list[np.ndarray]) -> np.ndarray:
    """Rows below each other, the narrower ones filled up with black."""
    width = max(row.shape[1] for row in rows)
    return np.concatenate([np.pad(row, ((0, 0), (0, width - row.shape[1]), (0, 0))) for row in rows])


def shown_moments(truth: TruthSet) -> dict[str, int]:
    """Of the seen frames that there are pictures of in every view, the middle and the last."""
    common = sorted(set.intersection(*(set(truth.frames[view]) for view in VIEWS)) & set(range(truth.num_seen)))
    return {"middle": common[len(common) // 2], "last": common[-1]}


def of_truth(truth: TruthSet, view: str, frame: int) -> np.ndarray:
    return small(truth.pictures(view)[truth.frames[view].index(frame)])


def of_job(job: Path, truth: TruthSet, view: str, frame: int) -> np.ndarray:
    with read_particles(job / PARTICLES_FILE) as particles:
        return small(ParticlePrediction(particles).picture(truth.view(view, frame), frame))


def small(picture: np.ndarray) -> np.ndarray:
    """[H, W, 4] linear premultiplied -> [h, w, 3] uint8 BGR, coded."""
    image = np.rint(255.0 * coded(picture)[..., ::-1]).astype(np.uint8)
    factor = min(1.0, _LARGEST / max(image.shape[:2]))
    return cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)


def over_angle(cells: list[dict[str, Any]], truths: dict[str, TruthSet]) -> Figure:
    """Of the view from the first frame's place: a panel for each scene."""
    figure, panels = plt.subplots(1, len(truths), figsize=(3.4 * len(truths), 3.4), sharey=True, squeeze=False)
    for panel, (scene, truth) in zip(panels[0], truths.items(), strict=True):
        for title, curve in curves(cells, scene, "nvs", ("copy", "billboard")):
            angles = [degrees_between(truth, "nvs", int(frame)) for frame in curve]
            panel.plot(angles, list(curve.values()), label=title, **_STYLES[title])
        panel.set_title(named(scene), fontsize=10)
        panel.set_xlabel("angle to the input camera, degrees")
    finished(figure, panels, "PSNR, dB")
    return figure


def over_horizon(cells: list[dict[str, Any]], truths: dict[str, TruthSet]) -> Figure:
    """Of the forecast: a panel for each scene, above in the input view, below from the first frame's place."""
    figure, panels = plt.subplots(2, len(truths), figsize=(3.4 * len(truths), 6.0), sharex=True, sharey="row", squeeze=False)
    for row, view in zip(panels, ("future_input", "future_nvs"), strict=True):
        for panel, (scene, truth) in zip(row, truths.items(), strict=True):
            for title, curve in curves(cells, scene, view, ("frozen reconstruction", "frozen copy")):
                seconds = [(int(frame) - truth.num_seen + 1) / truth.fps for frame in curve]
                panel.plot(seconds, list(curve.values()), marker=".", label=title, **_STYLES[title])
            panel.set_title(f"{named(scene)}: {'input view' if view == 'future_input' else 'first place'}", fontsize=9)
            panel.set_xlabel("seconds after the last seen frame")
    finished(figure, panels, "PSNR, dB")
    return figure


def curves(
    cells: list[dict[str, Any]], scene: str, view: str, trivial: tuple[str, ...]
) -> Iterator[tuple[str, dict[str, float]]]:
    """Titles and dB by frame: every method's, then the trivial answers beside the first of them."""
    found = {cell["method"]: cell["scores"][view] for cell in cells if cell["scene"] == scene and view in cell["scores"]}
    for method in METHODS:
        if method in found:
            yield titles(method), found[method]["ours"]["by_frame_db"]
    for name in trivial if found else ():
        yield name, next(iter(found.values()))[name]["by_frame_db"]


def degrees_between(truth: TruthSet, view: str, frame: int) -> float:
    """How far apart in azimuth two cameras look at a frame."""
    a, b = (camera_axes(truth.view(name, frame))[2] for name in (INPUT_VIEW, view))
    return float(np.degrees(np.arccos(np.clip(a @ b, -1.0, 1.0))))


def finished(figure: Figure, panels: np.ndarray, label: str) -> None:
    for panel in panels.flat:
        panel.grid(True, alpha=0.25)
    for row in panels:
        row[0].set_ylabel(label)
    panels.flat[0].legend(fontsize=8)
    figure.tight_layout()


if __name__ == "__main__":
    raise SystemExit(main())
