"""Forecasts are judged on frames behind the clip; and plumes that a file holds are not judged again."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from true_gaussians import true_gaussians

from backend.prior.weights import WEIGHTS, weights_fingerprint
from training import judge_forecast, verdicts
from training.judge import SEEN
from training.library import NUM_FRAMES, VELOCITY_EVERY, VOXEL_SIZE, Plume
from training.plumes import SIZE, plume


@pytest.fixture(scope="module")
def shrinking() -> Plume:
    """A ball of smoke that is there until the clip ends, and half as dense behind it."""
    shape = tuple(round(size / VOXEL_SIZE) for size in SIZE)
    x, y, z = np.meshgrid(*(np.arange(size) for size in shape), indexing="ij")
    density = 120 * np.exp(-((x - 18) ** 2 + (y - 20) ** 2 + (z - 25) ** 2) / 12)
    frames = np.stack([density if frame < SEEN else 0.5 * density for frame in range(NUM_FRAMES)])
    return Plume(
        scene=plume(3),
        density=frames.astype(np.uint8),
        velocity=np.zeros((NUM_FRAMES // VELOCITY_EVERY + 1, *shape, 3), np.float16),
        origin=(-5.83, -5.83, 0.17),
    )


def test_what_is_foretold_rightly_is_known(shrinking: Plume) -> None:
    seen = true_gaussians(shrinking, shift=0.0)[0]
    right = replace(seen, optical_masses=np.float32(0.5) * seen.optical_masses)
    moved = replace(right, positions=right.positions + np.array([2.0, 2.0, 1.0]))
    scores = [judge_forecast.likeness_of(shrinking, [record] * (NUM_FRAMES - SEEN)) for record in (right, seen, moved)]
    assert set(scores[0]) == {"input_db", "nvs_db", "side_db"}
    for view, best in scores[0].items():
        assert best > 35.0 and best > scores[1][view] + 5.0 and best > scores[2][view] + 5.0


def test_plumes_that_the_file_holds_are_not_judged_again(
    shrinking: Plume, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("a", "b"):
        (tmp_path / "plumes" / name).mkdir(parents=True)
        (tmp_path / "plumes" / name / "plume.json").touch()
    read = {"a": plume(3), "b": plume(4)}
    monkeypatch.setattr(verdicts, "Prior", lambda weights: None)
    monkeypatch.setattr(verdicts, "read_plume", lambda folder: replace(shrinking, scene=read[folder.name]))
    file, asked = tmp_path / "found.json", []

    def judged(of: Plume, prior: object, config: object) -> dict[str, float]:
        asked.append(of.scene.name)
        if len(asked) == 2:
            raise KeyboardInterrupt
        return {"wind": 1.0}

    arguments = ["--plumes", str(tmp_path / "plumes"), "--json", str(file)]
    with pytest.raises(KeyboardInterrupt):
        verdicts.judge_all(arguments, judged, description=None, label="judge")
    assert verdicts.judge_all(arguments, judged, description=None, label="judge") == 0
    names = [scene.name for scene in read.values()]
    assert asked == [names[0], names[1], names[1]]
    found = json.loads(file.read_text())
    assert found == {"weights": weights_fingerprint(WEIGHTS)[:12], "preset": "draft", "plumes": {n: {"wind": 1.0} for n in names}}
    with pytest.raises(SystemExit):
        verdicts.judge_all([*arguments, "--preset", "final"], judged, description=None, label="judge")
