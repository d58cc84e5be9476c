"""What lasts: a still thing seen from a way around it, and a plume that waves."""

from __future__ import annotations

import numpy as np
import pytest

from backend.field.rays import optical_depth
from backend.fit.lasting import Sighting, lasting
from backend.geometry.camera import View, view_at
from backend.geometry.lattice import Lattice
from backend.score.measures import correlation
from synthetic.sweep import Orbit, orbit_cameras

LATTICE = Lattice(origin=(-3.75, -3.75, 0.25), voxel_size=0.5, shape=(16, 16, 24))
NUM_VIEWS = 13


def views(degrees: float) -> list[View]:
    orbit = Orbit(target=(0.0, 0.0, 6.0), distance=25.0, half_height=7.0, azimuth_start=-90.0, azimuth_stop=degrees - 90.0)
    cameras = orbit_cameras(orbit, width=36, height=56, fps=15.0, num_frames=NUM_VIEWS)
    return [view_at(cameras, frame) for frame in range(NUM_VIEWS)]


def blob(x: float, y: float, z: float = 6.0) -> np.ndarray:
    away = LATTICE.centres() - (x, y, z)
    return np.exp(-0.5 * np.square(away / (0.8, 0.8, 2.5)).sum(axis=-1)).astype(np.float32)


def middle_in_depth(density: np.ndarray, first: View) -> float:
    away = LATTICE.centres() @ first.camera_to_world[:3, 2]
    return float((density * away).sum() / density.sum())


@pytest.mark.parametrize("degrees", [60.0, 120.0])
def test_a_way_around_tells_the_depth_that_a_guess_has_wrong(degrees: float) -> None:
    truth, guess = blob(0.5, 1.5), np.full(LATTICE.shape, 0.1, np.float32)
    seen = [Sighting(depth=optical_depth(truth, LATTICE, view), view=view, weight=1.0) for view in views(degrees)]
    found = lasting(guess, LATTICE, seen)
    front = views(degrees)[0]
    wrong = abs(middle_in_depth(guess, front) - middle_in_depth(truth, front))
    assert abs(middle_in_depth(found, front) - middle_in_depth(truth, front)) < 0.15 * wrong
    assert correlation(found, truth) > 0.75


def test_from_one_place_the_guess_stays_in_depth() -> None:
    truth, guess = blob(0.5, 1.5), blob(0.5, -1.0) + 1e-3
    front = views(60.0)[0]
    found = lasting(guess, LATTICE, [Sighting(depth=optical_depth(truth, LATTICE, front), view=front, weight=1.0)])
    assert middle_in_depth(found, front) == pytest.approx(middle_in_depth(guess, front), abs=0.2)
    shown, wanted = (optical_depth(density, LATTICE, front) for density in (found, truth))
    assert np.abs(shown - wanted).max() < 0.05 * wanted.max()


def test_of_a_plume_that_waves_the_mean_is_found() -> None:
    moments = [blob(0.5 + np.sin(2.1 * index), 1.0 + np.cos(3.3 * index)) for index in range(NUM_VIEWS)]
    seen = [
        Sighting(depth=optical_depth(density, LATTICE, view), view=view, weight=1.0)
        for density, view in zip(moments, views(60.0), strict=True)
    ]
    found = lasting(np.full(LATTICE.shape, 0.1, np.float32), LATTICE, seen)
    assert correlation(found, np.mean(moments, axis=0)) > 0.85
    assert np.isfinite(found).all()
    assert found.min() >= 0.0


def test_weights_count_and_what_nobody_sees_stays() -> None:
    front, other = views(60.0)[0], views(60.0)[-1]
    first, second = blob(-1.0, 0.0), blob(1.0, 0.0)
    sightings = [
        Sighting(depth=optical_depth(first, LATTICE, front), view=front, weight=1.0),
        Sighting(depth=optical_depth(second, LATTICE, other), view=other, weight=1e-6),
    ]
    guess = np.full(LATTICE.shape, 0.1, np.float32)
    found, alone = lasting(guess, LATTICE, sightings), lasting(guess, LATTICE, sightings[:1])
    assert correlation(found, alone) > 0.99
    far = Lattice(origin=(500.0, 500.0, 0.25), voxel_size=0.5, shape=(4, 4, 4))
    few = np.full(far.shape, 0.1, np.float32)
    np.testing.assert_array_equal(lasting(few, far, sightings), few)
