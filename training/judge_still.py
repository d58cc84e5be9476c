"""What a fit makes of plumes filmed by a camera that stands still, three ways, held against the smoke that is truly there.

    .venv/backend/bin/python -m training.judge_still --plumes DIR --json FILE [--preset draft] [--weights FILE]

Such a camera cannot tell small and near from large and far. So each fit is put at the smoke's true distance first, as large as
that makes it: the camera's own picture stays the same. Ways: by the images and the silhouette alone; by the prior alone; and by
the prior's motion with smoke as deep as it is wide, as jobs of such cameras are. The plumes must be none that the prior was
taught on. Every plume is written as soon as it is judged; those that the file holds are not judged again.
"""

from __future__ import annotations

from backend import kernel_setup  # noqa: F401 before numba loads

# isort: split
import argparse
import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from backend.contract.cameras import Cameras
from backend.contract.job import Config, preset_config
from backend.fit.state import VisualRecord
from backend.geometry.camera import View, view_at
from backend.io.atomic import write_text
from backend.prior.predict import Prior
from backend.prior.weights import WEIGHTS, weights_fingerprint
from backend.reporting import SilentReport
from backend.stages import physical, visual, volume
from synthetic.progress import Progress
from synthetic.sweep import Orbit, still_cameras
from training.judge import SEEN, SIZE, filmed_by, judge_particles, moments
from training.library import FPS, Plume, read_plume
from training.samples import lattice_of

WAYS = {"by the images": None, "by the prior": False, "as deep as wide": True}
_VIEWS = {"turned_30_db": 30.0, "side_db": 90.0, "back_db": 180.0}  # degrees from the camera


def judged(plume: Plume, prior: Prior, config: Config, *, seed: int) -> dict[str, dict[str, float]]:
    """Of each way what `judge_particles` says, and by how much the fit had to be made larger."""
    report = SilentReport()
    still = standing(0.0)
    cameras = replace(still, camera_to_world=still.camera_to_world * SEEN)
    layers = filmed_by(plume, cameras, np.random.default_rng(seed))
    found = {}
    for name, as_wide in WAYS.items():
        fluid, records = [], None
        if as_wide is None:
            fluid = list(physical.run(layers, cameras, config.physical, report, seed=0, done=[]))
        else:
            plan = volume.make_plan(layers, cameras, every=config.volume.every, finer=config.volume.finer, as_wide=as_wide)
            if plan is None:
                return {}
            plan = volume.centred(plan, report, prior=prior)
            proposals = list(volume.propose(plan, report, prior=prior, done=[]))
            records = list(volume.run(plan, report, proposals, levels=prior.levels, shares=prior.shares))
        particles = list(
            visual.run(layers, cameras, fluid, config.visual, report, seed=0, done=[], volumes=records, as_wide=bool(as_wide))
        )
        larger = distance_error(plume, particles, view_at(still, 0))
        placed = [made_larger(record, view_at(still, 0), larger) for record in particles]
        found[name] = {"larger": round(larger, 3), **judge_particles(plume, cameras, placed, views=views_around)}
    return found


def distance_error(plume: Plume, records: list[VisualRecord], view: View) -> float:
    """How many times as far away the smoke is as its fit, in the mean over the clip."""
    forward, lattice = view.camera_to_world[:3, 2], lattice_of(plume)
    away = (np.stack(np.meshgrid(*lattice.axes(), indexing="ij"), axis=-1) - view.position) @ forward
    real, ours = [], []
    for frame in moments(plume):
        masses, density = records[frame].optical_masses.astype(np.float64), plume.density_at(frame)
        if masses.sum() > 0.0:
            real.append(np.average(away, weights=density))
            ours.append(np.average((records[frame].positions - view.position) @ forward, weights=masses))
    return float(np.mean(real) / np.mean(ours)) if ours else 1.0


def made_larger(record: VisualRecord, view: View, factor: float) -> VisualRecord:
    """The same picture from further away."""
    return replace(
        record,
        positions=view.position + factor * (record.positions - view.position),
        velocities=(factor * record.velocities).astype(np.float32),
        scales=(factor * record.scales).astype(np.float32),
        optical_masses=(factor**2 * record.optical_masses).astype(np.float32),
    )


def standing(degrees: float) -> Cameras:
    width, height = SIZE
    return still_cameras(Orbit(), turned=degrees, width=width, height=height, fps=FPS)


def views_around(frame: int) -> dict[str, View]:
    return {name: view_at(standing(degrees), 0) for name, degrees in _VIEWS.items()}


def main(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--plumes", type=Path, required=True)
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--preset", default="draft")
    parser.add_argument("--weights", type=Path, default=WEIGHTS)
    given = parser.parse_args(arguments)
    folders = sorted(path.parent for path in given.plumes.glob("*/plume.json"))
    mark = weights_fingerprint(given.weights)[:12]
    results: dict[str, Any] = {"weights": mark, "preset": given.preset, "plumes": {}}
    if given.json.exists():
        results = json.loads(given.json.read_text(encoding="utf-8"))
        if (results["weights"], results["preset"]) != (mark, given.preset):
            parser.error(f"{given.json} is of other weights or another preset; name another file.")
    prior, config = Prior(given.weights), preset_config(given.preset)
    progress = Progress(label="judge plumes before a still camera", total=len(folders))
    for folder in folders:
        plume = read_plume(folder)
        if plume.scene.name not in results["plumes"]:
            results["plumes"][plume.scene.name] = judged(plume, prior, config, seed=plume.scene.seed)
            write_text(given.json, json.dumps(results, indent=1) + "\n")
        progress.step()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
