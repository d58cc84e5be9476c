"""What a fit makes of plumes filmed by a camera that stands still, three ways, held against the smoke that is truly there.

    .venv/backend/bin/python -m training.judge_still --plumes DIR --json FILE [--preset draft] [--weights FILE]

Such a camera cannot tell small and near from large and far. So each fit is put at the smoke's true distance first, as large as
that makes it: the camera's own picture stays the same. Ways: by the images and the silhouette alone; by the prior alone; and by
the prior's motion with smoke as deep as it is wide, as jobs of such cameras are. The plumes must be none that the prior was
taught on.
"""

from __future__ import annotations

from backend import kernel_setup  # noqa: F401 before numba loads

# isort: split
import sys
from dataclasses import replace

import numpy as np

from backend.contract.job import Config
from backend.fit.state import VisualRecord
from backend.geometry.camera import View, view_at
from backend.prior.predict import Prior
from backend.reporting import SilentReport
from backend.stages import physical, visual
from training.judge import SEEN, filmed_by, judge_particles, moments, standing, volumes_of
from training.judge_command import judge_all
from training.library import Plume
from training.samples import lattice_of

WAYS = {"by the images": None, "by the prior": False, "as deep as wide": True}
_VIEWS = {"turned_30_db": 30.0, "side_db": 90.0, "back_db": 180.0}  # degrees from the camera


def judged(plume: Plume, prior: Prior, config: Config) -> dict[str, dict[str, float]]:
    """Of each way what `judge_particles` says, and by how much the fit had to be made larger."""
    report = SilentReport()
    still = standing(0.0)
    cameras = replace(still, camera_to_world=still.camera_to_world * SEEN)
    layers = filmed_by(plume, cameras, np.random.default_rng(plume.scene.seed))
    found = {}
    for name, as_wide in WAYS.items():
        fluid, records = [], None
        if as_wide is None:
            fluid = list(physical.run(layers, cameras, config.physical, report, seed=0, done=[]))
        else:
            settings = replace(config.volume, as_deep_as_wide=as_wide)
            records = volumes_of(layers, cameras, prior, settings, report)
            if records is None:
                return {}
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


def views_around(frame: int) -> dict[str, View]:
    return {name: view_at(standing(degrees), 0) for name, degrees in _VIEWS.items()}


def main(arguments: list[str]) -> int:
    return judge_all(arguments, judged, description=__doc__, label="judge plumes before a still camera")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
