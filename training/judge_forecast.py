"""How right forecasts are of plumes that go on behind the clip.

    .venv/backend/bin/python -m training.judge_forecast --plumes DIR --json FILE [--preset draft] [--weights FILE]

Each plume is filmed as the benchmark's scenes are, by a camera that goes around it, and its first 120 frames are fitted; the
other 15 are foretold. The trivial answer beside it is the last fitted frame at rest. The plumes must be none that the prior was
taught on.
"""

from __future__ import annotations

from backend import kernel_setup  # noqa: F401 before numba loads

# isort: split
import sys
from typing import Any

import numpy as np

from backend.contract.job import Config
from backend.fit.future import trust_of
from backend.fit.scene import make_scene
from backend.fit.state import VisualRecord, particle_frame
from backend.geometry.camera import view_at
from backend.prior.predict import Prior
from backend.render.picture import picture
from backend.reporting import SilentReport
from backend.stages import forecast, physical, visual
from training.judge import SEEN, film, going_around, likeness, standing, volumes_of
from training.judge_command import judge_all
from training.library import NUM_FRAMES, Plume

WAYS = ("at rest", "foretold")
_STEP = 2  # frames: every second one is looked at


def judged(plume: Plume, prior: Prior, config: Config) -> dict[str, Any]:
    """Of the plume its wind, m/s; of either way the mean PSNR of the foretold frames, dB, in the input's view, from its first
    place and from aside."""
    report, ahead = SilentReport(), NUM_FRAMES - SEEN
    layers, cameras = film(plume, np.random.default_rng(plume.scene.seed))
    volumes = volumes_of(layers, cameras, prior, config.volume, report)
    if volumes is None:
        return {}
    fluid = list(physical.run(layers, cameras, config.physical, report, seed=0, done=[], volumes=volumes))
    seen = list(visual.run(layers, cameras, fluid, config.visual, report, seed=0, done=[], volumes=volumes))
    known = forecast.Known(scene=make_scene(layers, cameras), layers=layers, fluid=fluid, seen=seen, volumes=volumes)
    found: dict[str, Any] = {"wind": round(float(np.hypot(*plume.scene.wind)), 3)}
    foretold = list(forecast.foretold(known, trust_of(known.last, config.forecast), ahead))
    for name, records in zip(WAYS, ([known.last] * ahead, foretold), strict=True):
        found[name] = likeness_of(plume, records)
    return found


def likeness_of(plume: Plume, foretold: list[VisualRecord]) -> dict[str, float]:
    """Of the records of all frames behind the clip, as `judged` says."""
    filmed, found = going_around(), {"input_db": [], "nvs_db": [], "side_db": []}
    for frame in range(SEEN, NUM_FRAMES, _STEP):
        ours = particle_frame(foretold[frame - SEEN])
        views = view_at(filmed, frame), view_at(standing(0.0), 0), view_at(standing(90.0), 0)
        for values, view in zip(found.values(), views, strict=True):
            values.append(likeness(picture(ours, view), plume, frame, view))
    return {name: round(float(np.mean(values)), 3) for name, values in found.items()}


def main(arguments: list[str]) -> int:
    return judge_all(arguments, judged, description=__doc__, label="judge forecasts")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
