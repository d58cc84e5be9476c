"""A whole job: what its asset says of the forecast, and what is done anew when only the forecast changes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from backend.contract import events
from backend.contract.job import Job, override, preset_config
from backend.events_out import StopRequest
from backend.fit.state import VisualRecord
from backend.io.job_folder import JobFolder
from backend.io.particles import read_particles
from backend.io.records import RecordFile
from backend.pipeline import run_job
from backend.stages.forecast import deviations

SMALL: dict[str, Any] = {
    "frames.working_size": 64,
    "physical.num_particles": 100,
    "physical.correction_iterations": 1,
    "visual.num_particles": 200,
    "visual.iterations": 1,
    "published.num_physical": 60,
    "published.num_particles": 100,
    "published.physical_iterations": 1,
    "published.visual_iterations": 1,
    "export.max_voxels": 16,
}


class Heard:
    """A sink that remembers which stages were done."""

    def __init__(self) -> None:
        self.done: list[str] = []

    def send(self, event: events.Event) -> None:
        if isinstance(event, events.Stage) and not event.skipped:
            self.done.append(event.name)

    def close(self) -> None: ...


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("clip")
    y, x = np.mgrid[0:64, 0:48].astype(np.float32)
    for frame in range(5):
        puff = np.exp(-((x - 24) ** 2 + (y - 44 + 3 * frame) ** 2) / 60.0)
        cv2.imwrite(str(folder / f"{frame:04d}.png"), (200 * puff * (puff > 0.02)).astype(np.uint8))
    return folder


def run(clip: Path, folder: Path, **changes: object) -> list[str]:
    overrides = {**SMALL, **{key.replace("__", "."): value for key, value in changes.items()}}
    folder.mkdir(exist_ok=True)
    JobFolder(folder).write_job(Job(video=str(clip), preset="draft", overrides=overrides))
    heard = Heard()
    run_job(folder, heard, StopRequest())
    return heard.done


def provenance(folder: Path) -> dict[str, Any]:
    with read_particles(folder / "particles.h5") as particles:
        return dict(particles.info.provenance)


def test_the_asset_says_how_far_to_trust_it(clip: Path, tmp_path: Path) -> None:
    job = tmp_path / "job"
    assert "forecast" in run(clip, job, forecast__num_frames=3)
    said = provenance(job)["forecast_deviation_m"]
    config = override(preset_config("draft"), {"forecast.num_frames": 3}).forecast
    with RecordFile(JobFolder(job).visual, VisualRecord) as seen:
        expected = deviations(seen[len(seen) - 1], config, seconds=1.0 / 24.0)
    assert said == pytest.approx(expected)
    assert 0.0 < said[0] < said[1] < said[2]
    assert run(clip, job, forecast__num_frames=3) == []
    assert run(clip, job, forecast__num_frames=3, forecast__fading=1.0) == ["forecast", "export"]
    assert run(clip, job) == ["forecast", "export"]
    assert "forecast_deviation_m" not in provenance(job)


def test_the_published_methods_say_nothing_of_it(clip: Path, tmp_path: Path) -> None:
    run(clip, tmp_path / "job", method="fluidnexus", forecast__num_frames=1)
    assert "forecast_deviation_m" not in provenance(tmp_path / "job")
