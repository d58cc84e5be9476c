"""How right the motion of finished jobs is by the size of eddies, and what any answer of a given sharpness could reach.

    python -m benchmarks.velocity_scales --jobs DIR [--from SET] [--scenes A,B] [--json FILE]

DIR holds finished jobs, as benchmarks.reconstruction leaves them in OUT/PRESET/default. Correlations with the true velocity
inside true smoke, sideways, up and in depth as the input camera sees it, means over the moments with smoke, as `evaluate`
has them:

ours          both sides blurred alike over the smoke around, by Gaussians of that standard deviation: smaller is forgotten
sharpness     the true velocity so blurred, against itself: what is smaller is not known, all else without error
rays          its mean along each ray of the input camera against itself: all that can be seen of motion is known without error,
              and nothing of how it changes in depth

The last two are of the truth alone, bounds and no scores.
"""

from __future__ import annotations

from backend import kernel_setup  # noqa: F401 before numba loads

# isort: split
import json
import sys
from collections.abc import Sequence

import numpy as np
from scipy import ndimage

from backend.contract.truth import INPUT_VIEW
from backend.geometry.camera import View
from backend.io.atomic import write_text
from backend.io.job_folder import JobFolder
from backend.score.finished_job import open_job
from backend.score.measures import correlation, inside_smoke
from backend.score.truth_set import TruthSet, Volume, read_truth_set
from backend.score.volumes import LEAST_PEAK, Volumes, camera_axes
from benchmarks.finished_jobs import read_options
from benchmarks.reconstruction import UNTOUCHED
from synthetic.progress import Progress

BLURS = (0.0, 0.25, 0.5, 1.0)  # m
AXES = ("sideways", "up", "depth")


def main(arguments: Sequence[str] | None = None) -> int:
    given = read_options(arguments, description=__doc__)
    weights, scenes = given.weights(), {}
    for job in given.jobs:
        truth = read_truth_set(given.source / job.name)
        with open_job(JobFolder(job), truth) as opened:
            scenes[job.name] = scene_figures(opened.prediction, truth)
    for scene, ways in scenes.items():
        for way, found in ways.items():
            print(f"{scene:<18} {way:<16} " + " ".join(f"{name} {value:.3f}" for name, value in found.items()))
    if given.json is not None:
        untouched = [scene for scene in scenes if scene in UNTOUCHED]
        found = {"weights": weights, "untouched": untouched, "scenes": scenes}
        write_text(given.json, json.dumps(found, indent=1, allow_nan=False) + "\n")
    return 0


def scene_figures(prediction: Volumes, truth: TruthSet) -> dict[str, dict[str, float]]:
    """Of each way, by its name and the blur in m, the correlation along each of AXES."""
    frames = [frame for frame in truth.volume_frames(with_velocity=True) if 0 < frame < truth.num_seen]
    rows: dict[str, list[np.ndarray]] = {}
    progress = Progress(label=f"look at {truth.name}", total=len(frames))
    for frame in frames:
        real, view = truth.volume(frame), truth.view(INPUT_VIEW, frame)
        if real.velocity is not None and real.density.max() >= LEAST_PEAK:
            _, ours = prediction.volume(real, frame)
            for way, found in moment(ours, real, view).items():
                rows.setdefault(way, []).append(found)
        progress.step()
    return {
        way: dict(zip(AXES, (round(float(value), 4) for value in np.mean(of, axis=0)), strict=True)) for way, of in rows.items()
    }


def moment(ours: np.ndarray, real: Volume, view: View) -> dict[str, np.ndarray]:
    """[3] each, along AXES. ours [X, Y, Z, 3] m/s on the voxels of `real`."""
    assert real.velocity is not None
    axes, inside = camera_axes(view), inside_smoke(real.density)
    turned = [np.asarray(field, np.float64) @ axes.T for field in (ours, real.velocity)]
    truth = turned[1][inside]
    found = {}
    for blur in BLURS:
        own, true = (blurred(field, inside, blur / real.voxel_size)[inside] for field in turned)
        found[f"ours, {blur:g}"] = correlations(own, true)
        found[f"sharpness, {blur:g}"] = correlations(true, truth)
    found["rays"] = correlations(means_of_rays(truth, real.lattice.centres()[inside], view, real.voxel_size), truth)
    return found


def blurred(field: np.ndarray, inside: np.ndarray, sigma: float) -> np.ndarray:
    """[X, Y, Z, 3]: means over what is `inside` [X, Y, Z] around; sigma: voxels."""
    if sigma == 0.0:
        return field
    weight = ndimage.gaussian_filter(inside.astype(np.float64), sigma, mode="constant")
    sums = [ndimage.gaussian_filter(np.where(inside, field[..., axis], 0.0), sigma, mode="constant") for axis in range(3)]
    return np.stack(sums, axis=-1) / np.maximum(weight, 1e-12)[..., None]


def means_of_rays(values: np.ndarray, points: np.ndarray, view: View, width: float) -> np.ndarray:
    """values [N, 3] at points [N, 3] m -> their means over the points of each ray, `width` m wide where the points are."""
    at = view.to_camera(points)
    rays = np.floor(at[:, :2] / at[:, 2:] * (np.median(at[:, 2]) / width)).astype(np.int64)
    _, index, count = np.unique(rays, axis=0, return_inverse=True, return_counts=True)
    sums = np.stack([np.bincount(index.ravel(), column) for column in values.T], axis=1)
    return (sums / count[:, None])[index.ravel()]


def correlations(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """[3] of the columns of [N, 3]."""
    return np.array([correlation(a[:, axis], b[:, axis]) for axis in range(3)])


if __name__ == "__main__":
    sys.exit(main())
