"""Poisson's equation with a weight in each voxel."""

from __future__ import annotations

import numpy as np

from backend.field.poisson import weighted_poisson


def test_a_weighted_flow_has_the_divergence_that_was_asked_for() -> None:
    rng = np.random.default_rng(4)
    weight = rng.uniform(0.2, 2.0, (9, 8, 7))
    potential = rng.normal(size=(9, 8, 7))
    wanted = np.zeros_like(weight)
    for axis in range(3):
        face = 0.5 * (np.delete(weight, 0, axis) + np.delete(weight, -1, axis))
        wanted += np.diff(face * np.diff(potential, axis=axis), axis=axis, prepend=0.0, append=0.0)
    found = weighted_poisson(weight, wanted)
    error = (found - found.mean()) - (potential - potential.mean())
    assert np.linalg.norm(error) < 0.1 * np.linalg.norm(potential)
    assert np.abs(weighted_poisson(weight, np.zeros_like(weight))).max() == 0.0
