"""Densities that know nothing but their own frame, or little more, beside those that finished jobs made of the whole clip.

    python -m benchmarks.per_frame --jobs DIR [--from SET] [--scenes A,B] [--json FILE]

DIR holds finished jobs, as benchmarks.reconstruction leaves them in OUT/PRESET/default. Correlations with the true density, means
over the moments with smoke, as `evaluate` has them:

cross-section     of the frame's silhouette, as deep as it is wide (backend/fit/depth_prior.py), at the distance of the source,
                  with the optical depth that the frame shows: row A of the prototype that this project started from
network           what the prior's large network says of the frame and those around it, with the frame's optical depth
"""

from __future__ import annotations

from backend import kernel_setup  # noqa: F401 before numba loads

# isort: split
import json
import math
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from backend.contract.cameras import Cameras, read_cameras
from backend.fit.depth_prior import inflate
from backend.fit.guide import Guide
from backend.fit.scene import Scene, make_scene, optical_depth
from backend.fit.sharpen import agreed
from backend.fit.state import VolumeRecord
from backend.io.atomic import write_text
from backend.io.frame_stack import FrameStack
from backend.io.job_folder import JobFolder
from backend.io.records import open_stage_file
from backend.prior.predict import Prior
from backend.prior.weights import weights_fingerprint
from backend.prior.window import Stand
from backend.reporting import SilentReport
from backend.score.truth_set import Volume, read_truth_set
from backend.score.volumes import volume_scores
from backend.stages import volume
from benchmarks.finished_jobs import read_options
from synthetic.progress import Progress

_SUM = 3 * math.pi / 8  # of (1 - s^2)^1.5 over -1..1


class CrossSections:
    """Of each frame's silhouette. layers: of smoke, by frame."""

    def __init__(self, layers: FrameStack, scene: Scene) -> None:
        self.layers, self.scene = layers, scene

    def volume(self, like: Volume, frame: int) -> tuple[np.ndarray, np.ndarray]:
        """See backend/score/volumes.py; it knows no velocity."""
        depth, view = optical_depth(self.layers[frame]), self.scene.views[frame]
        solid = inflate(depth, view, self.scene.anchor)
        points = like.lattice.centres().reshape(-1, 3)
        pixels, away = view.project(points)
        columns, rows = (np.floor(pixels[:, axis]).astype(int) for axis in (0, 1))
        inside = (away > 0) & (columns >= 0) & (columns < view.width) & (rows >= 0) & (rows < view.height)
        at = rows[inside], columns[inside]
        half = solid.half_thickness[at]
        profile = np.maximum(1 - np.square((away[inside] - solid.center_depth[at]) / half), 0.0) ** 1.5
        density = np.zeros(len(points), np.float32)
        density[inside] = np.where(solid.is_smoke[at], depth[at] * profile / (_SUM * half), 0.0)
        stand = Stand(lattice=like.lattice, from_world=np.eye(4))
        found = agreed(density.reshape(like.lattice.shape), stand, depth, view)
        return found, np.zeros((*found.shape, 3), np.float32)


class Network:
    """What the prior's large network says of each frame. records: by frame."""

    def __init__(self, records: Sequence[VolumeRecord]) -> None:
        self.guides = [Guide(record) for record in records]

    def volume(self, like: Volume, frame: int) -> tuple[np.ndarray, np.ndarray]:
        """See backend/score/volumes.py."""
        points, shape = like.lattice.centres().reshape(-1, 3), like.lattice.shape
        guide = self.guides[frame]
        return guide.density_at(points).reshape(shape), guide.velocity_at(points).reshape(*shape, 3)


def main(arguments: Sequence[str] | None = None) -> int:
    given = read_options(arguments, description=__doc__)
    scenes = {job.name: scene_figures(job, given.source / job.name) for job in given.jobs}
    for scene, figures in scenes.items():
        print(f"{scene:<18} " + " ".join(f"{name} {value:.3f}" for name, value in figures.items()))
    if given.json is not None:
        found = {"weights": weights_fingerprint()[:12], "scenes": scenes}
        write_text(given.json, json.dumps(found, indent=1, allow_nan=False) + "\n")
    return 0


def scene_figures(job: Path, truth_set: Path) -> dict[str, float]:
    """Density correlation of each."""
    folder, truth, report = JobFolder(job), read_truth_set(truth_set), SilentReport()
    cameras = read_cameras(folder.cameras)
    with open_stage_file(folder.smoke) as file:
        layers = FrameStack(file, "smoke")
        ways = {
            "cross-section": CrossSections(layers, make_scene(layers, cameras)),
            "network": Network(own_words(layers, cameras, name=job.name)),
        }
        return {name: volume_scores(way, truth, report=report)["correlation"] for name, way in ways.items()}


def own_words(layers: FrameStack, cameras: Cameras, *, name: str) -> list[VolumeRecord]:
    """Of all frames: what the large network says, on a fit's grids and at a fit's moments, as the frames show it."""
    prior, report = Prior(), SilentReport()
    plan = volume.make_plan(layers, cameras, every=5)
    if plan is None:
        raise SystemExit(f"{name} shows no smoke; take it out of the folder of jobs.")
    plan = volume.centred(plan, report, prior=prior)
    progress, proposals = Progress(label=f"ask about {name}", total=len(plan.asked)), []
    for record in volume.propose(plan, report, prior=prior, done=[]):
        proposals.append(record)
        progress.step()
    return [
        plan.record(replace(word.said, density=plan.agreed(word.said.density, word.said.stand, word.frame)), word.frame)
        for word in volume.words(plan, proposals, None, range(plan.region.num_frames))
    ]


if __name__ == "__main__":
    sys.exit(main())
