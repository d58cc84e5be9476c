"""The published methods through the command line: the whole path, and the same bytes when it was interrupted."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from small_job import assert_whole, backend, digest, settings

from backend.io.particles import read_particles

SMALL = {
    "published.num_physical": "100",
    "published.num_particles": "250",
    "published.physical_iterations": "2",
    "published.visual_iterations": "2",
}


@pytest.mark.parametrize("method", ["as_published", "fluidnexus"])
def test_a_method_makes_an_asset_and_resumes(method: str, plume: Path, tmp_path: Path) -> None:
    job = tmp_path / "job"
    command = ("reconstruct", plume, "--job", job, "--frames", "0:5", *settings(method=method, **SMALL))
    done = backend(*command)
    assert done.returncode == 0, done.stdout + done.stderr
    with read_particles(job / "particles.h5") as particles:
        assert (particles.num_frames, particles.num_forecast) == (5, 2)
        frame = particles.frame(4)
        assert frame.rotations is not None and frame.count > 50
        assert particles.info.provenance["settings"]["method"] == method
        assert np.isclose(particles.info.buoyancy[2], 1.0) == (method == "fluidnexus")
        assert set(particles.info.fluid) == {"smoothing_length_m", "rest_density", "surface_drag_per_second"}
    assert assert_whole(job) > 10
    first = digest(job)
    for name in ("result.json", "particles.h5", "stages/visual.h5"):
        (job / name).unlink()
    again = backend(*command)
    assert again.returncode == 0, again.stderr
    skipped = [e["name"] for e in map(json.loads, again.stdout.splitlines()) if e["event"] == "stage" and e["skipped"]]
    assert "physical" in skipped and "visual" not in skipped
    assert digest(job) == first


def test_an_unknown_method_is_refused(plume: Path, tmp_path: Path) -> None:
    refused = backend("reconstruct", plume, "--job", tmp_path / "job", "--set", "method=magic")
    assert refused.returncode == 2
    assert "as_published" in json.loads(refused.stdout.splitlines()[-1])["message"]
