"""How good a job is, by a few frames of each view: seconds where `evaluate` takes minutes. For comparing settings with each
other, not for figures that stand beside published ones.

Decibels are of sRGB on black, at most 50 a frame, as in `evaluate`; means over frames.

    python -m benchmarks.trade_score SCENE --pictures DIR --frames A:B --out FILE    what needs no reconstruction
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np

from backend.contract.truth import INPUT_VIEW
from backend.io.atomic import whole_file, write_text
from backend.io.job_folder import JobFolder
from backend.io.particles import read_particles
from backend.score import baselines, measures
from backend.score.exported import Exported, opacity_in_clip
from backend.score.particles import ParticlePrediction
from backend.score.truth_set import TruthSet, Volume, read_truth_set
from backend.score.volumes import camera_axes

VIEWS = (INPUT_VIEW, "nvs", "side")
INPUT_STEP = 4  # every which frame of the input view is scored; the other views have few
SPARSEST = 0.05  # 1/m: a moment whose peak is below holds no smoke


def score_window(folder: JobFolder, scene: Path, pictures: Path, *, scored: tuple[int, int]) -> dict[str, float]:
    """Figures of the video frames scored[0] to scored[1] - 1, and of the forecast behind them. pictures: a folder for the
    true pictures as arrays, made once. A figure that nothing gives is left out."""
    truth = read_truth_set(scene)
    with read_particles(folder.particles) as particles:
        prediction = ParticlePrediction(particles)
        found: dict[str, float] = {}
        for view in VIEWS:
            found |= _view(prediction, truth, view, true_pictures(truth, view, pictures), scored)
        found |= _volumes(prediction, truth, scored)
        exported = Exported(folder.vdb, frame_start=particles.info.frame_start)
        found |= _export(exported, truth, true_pictures(truth, INPUT_VIEW, pictures), scored)
        found["vdb_mib_a_frame"] = _mean([path.stat().st_size / 1024**2 for path in folder.vdb.glob("*.vdb")])
    return {name: round(value, 4) for name, value in found.items() if np.isfinite(value)}


def true_pictures(truth: TruthSet, view: str, folder: Path) -> np.ndarray:
    """[F, H, W, 4] float32, as TruthSet.pictures; kept as a file, of which only what is looked at is read."""
    path = folder / f"{truth.name}_{view}.npy"
    if not path.exists():
        folder.mkdir(parents=True, exist_ok=True)
        whole = np.asarray(truth.pictures(view), np.float32)
        with whole_file(path) as part, open(part, "wb") as file:
            np.save(file, whole)
    return np.load(path, mmap_mode="r")


def frames_of(truth: TruthSet, view: str, scored: tuple[int, int]) -> list[int]:
    """The video frames of a view that are looked at, from scored[0] on."""
    step = INPUT_STEP if view == INPUT_VIEW else 1
    return [frame for frame in truth.frames[view] if frame >= scored[0]][::step]


def trivial_scores(scene: Path, pictures: Path, *, scored: tuple[int, int]) -> dict[str, float]:
    """What the input picture gets in the other views, as it is and mirrored: what a reconstruction must be better than."""
    truth = read_truth_set(scene)
    seen = true_pictures(truth, INPUT_VIEW, pictures)
    found = {}
    for view in VIEWS[1:]:
        targets = true_pictures(truth, view, pictures)
        frames = [frame for frame in frames_of(truth, view, scored) if frame < scored[1]]
        for name in ("copy", "mirror"):
            values = []
            for frame in frames:
                views = truth.view(INPUT_VIEW, frame), truth.view(view, frame)
                shown = baselines.trivial_view(name, np.asarray(seen[frame]), *views, np.zeros(3))
                target = np.asarray(targets[truth.frames[view].index(frame)])
                values.append(measures.decibels(measures.squared_errors(shown, target)[0]))
            found[f"{view}_{name}_db"] = round(float(np.mean(values)), 4)
    return found


def _view(
    prediction: ParticlePrediction, truth: TruthSet, view: str, targets: np.ndarray, scored: tuple[int, int]
) -> dict[str, float]:
    full: dict[int, float] = {}
    smoke: dict[int, float] = {}
    for frame in frames_of(truth, view, scored):
        if frame < prediction.num_frames:
            shown = prediction.picture(truth.view(view, frame), frame)
            errors = measures.squared_errors(shown, np.asarray(targets[truth.frames[view].index(frame)]))
            full[frame], smoke[frame] = (measures.decibels(error) for error in errors)
    seen = [frame for frame in full if frame < scored[1]]
    ahead = [full[frame] for frame in full if frame >= scored[1]]
    if view == INPUT_VIEW:
        found = {"input_db": _mean([full[frame] for frame in seen]), "input_smoke_db": _mean([smoke[frame] for frame in seen])}
    else:
        found = {f"{view}_db": _mean([full[frame] for frame in seen])}
    if view == "nvs":
        third = (scored[1] - scored[0]) / 3.0
        for index, name in enumerate(("first", "middle", "last")):
            part = [full[frame] for frame in seen if int((frame - scored[0]) / third) == index]
            found[f"nvs_{name}_db"] = _mean(part)
    return found | ({f"future_{view}_db": _mean(ahead)} if view != "side" else {})


def _volumes(prediction: ParticlePrediction, truth: TruthSet, scored: tuple[int, int]) -> dict[str, float]:
    density: list[float] = []
    mass = np.zeros(2)
    velocities: dict[str, list[float]] = {}
    for frame, real in _moments(truth, scored):
        ours, velocity = prediction.volume(real, frame)
        density.append(measures.correlation(ours, real.density))
        mass += ours.sum(dtype=np.float64), real.density.sum(dtype=np.float64)
        if real.velocity is not None:
            axes = camera_axes(truth.view(INPUT_VIEW, frame))
            for name, value in measures.velocity_scores(velocity, real.velocity, real.density, axes).items():
                velocities.setdefault(name, []).append(value)
    found = {"density_correlation": _mean(density), "mass_ratio": mass[0] / mass[1] if mass[1] > 0.0 else float("nan")}
    names = ("sideways", "up", "depth")
    return found | {f"velocity_{name}": _mean(velocities.get(f"correlation_{name}", [])) for name in names}


def _export(exported: Exported, truth: TruthSet, targets: np.ndarray, scored: tuple[int, int]) -> dict[str, float]:
    """Of the VDB files: how opaque they are in the input view, and their density at the true voxels."""
    frames = [frame for frame in frames_of(truth, INPUT_VIEW, scored) if frame < scored[1]]
    opacity = opacity_in_clip(exported.opacity, truth, targets, frames)
    densities = [
        measures.correlation(exported.density_at(real.lattice, frame), real.density) for frame, real in _moments(truth, scored)
    ]
    return {"vdb_opacity_db": float("nan") if opacity is None else opacity, "vdb_correlation": _mean(densities)}


def _moments(truth: TruthSet, scored: tuple[int, int]) -> list[tuple[int, Volume]]:
    """The true volumes of the scored frames that hold smoke."""
    found = [(frame, truth.volume(frame)) for frame in truth.volume_frames() if scored[0] <= frame < scored[1]]
    return [(frame, volume) for frame, volume in found if volume.density.max() >= SPARSEST]


def _mean(values: list[float]) -> float:
    known = [value for value in values if not np.isnan(value)]
    return float(np.mean(known)) if known else float("nan")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    for name in ("pictures", "out"):
        parser.add_argument(f"--{name}", type=Path, required=True)
    parser.add_argument("--frames", required=True)
    given = parser.parse_args()
    first, stop = map(int, given.frames.split(":"))
    write_text(given.out, json.dumps(trivial_scores(given.scene, given.pictures, scored=(first, stop)), allow_nan=False))
