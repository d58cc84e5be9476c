"""Forecasts are judged on frames behind the clip."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_plumes import ball, made_plume, true_gaussians

from training import judge_forecast
from training.judge import SEEN
from training.library import NUM_FRAMES, Plume


@pytest.fixture(scope="module")
def shrinking() -> Plume:
    """A ball of smoke that is there until the clip ends, and half as dense behind it."""
    return made_plume(np.stack([ball() if frame < SEEN else 0.5 * ball() for frame in range(NUM_FRAMES)]))


def test_what_is_foretold_rightly_is_known(shrinking: Plume) -> None:
    seen = true_gaussians(shrinking, shift=0.0)[0]
    right = replace(seen, optical_masses=np.float32(0.5) * seen.optical_masses)
    moved = replace(right, positions=right.positions + np.array([2.0, 2.0, 1.0]))
    scores = [judge_forecast.likeness_of(shrinking, [record] * (NUM_FRAMES - SEEN)) for record in (right, seen, moved)]
    assert set(scores[0]) == {"input_db", "nvs_db", "side_db"}
    for view, best in scores[0].items():
        assert best > 35.0 and best > scores[1][view] + 5.0 and best > scores[2][view] + 5.0
