"""Where smoke rises from: sources that stand still, in smoke that drifts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
import pytest

from backend.fit.foot import foot_point, standing_point
from backend.fit.scene import make_scene, optical_depth
from backend.fit.source import source_point
from backend.geometry.camera import View, resized, view_at
from benchmarks.tilted_scene import tilted, turn
from synthetic.sweep import Orbit, orbit_cameras, still_cameras

NUM_FRAMES, FPS = 24, 6.0
WIDTH, HEIGHT = 90, 160
ORBIT = Orbit()
CAMERAS = orbit_cameras(ORBIT, width=WIDTH, height=HEIGHT, fps=FPS, num_frames=NUM_FRAMES)
VIEWS = [view_at(CAMERAS, frame) for frame in range(NUM_FRAMES)]
TOWARDS = -VIEWS[NUM_FRAMES // 2].camera_to_world[:2, 2]  # the camera, half-way


def film(
    sources: list[tuple[float, float, float]],
    wind: np.ndarray,
    views: list[View] = VIEWS,
    *,
    out_at: float = np.inf,
    ages: Sequence[float] = tuple(np.arange(0.0, 5.0, 0.15)),
) -> list[np.ndarray]:
    """Optical depths [H, W] of puffs of equal mass that rise, drift in a wind [2] m/s and widen; the sources had burned for
    five seconds, and go out after some more. ages: of the puffs, s, in every frame."""
    row, column = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
    found = []
    for frame, view in enumerate(views):
        depth = np.zeros((HEIGHT, WIDTH), np.float32)
        for source in sources:
            for age in ages:
                if frame / FPS - age > out_at:
                    continue
                place = np.array(source) + age * np.array([*wind, 1.6])
                pixel, distance = view.project(place[None])
                spread = (0.25 + 0.2 * age) * view.fx / distance[0]
                off = np.square(column - pixel[0, 0]) + np.square(row - pixel[0, 1])
                depth += 40.0 / spread**2 * np.exp(-0.5 * off / spread**2)
        found.append(depth)
    return found


def layer_of(depth: np.ndarray) -> np.ndarray:
    """Its smoke layer [H, W, 4]."""
    opacity = -np.expm1(-depth)
    return np.dstack([0.4 * opacity] * 3 + [opacity]).astype(np.float32)


def test_smoke_that_has_left_a_source_for_long_is_none() -> None:
    """A dense puff stands still high above where the rest has risen from: the foot of it all counts."""
    low, high = (0.7, -0.9, 2.0), (2.0, 1.5, 9.0)
    rising, standing = film([low], np.zeros(2)), film([high], np.array([0.0, 0.0]), out_at=np.inf)
    depths = [0.2 * some + 3.0 * more for some, more in zip(rising, standing, strict=True)]
    found = source_point(depths.__getitem__, VIEWS)
    np.testing.assert_array_equal(found, foot_point(depths.__getitem__, VIEWS, most_frames=NUM_FRAMES))
    assert np.linalg.norm(source_point(standing.__getitem__, VIEWS)[:2] - high[:2]) < 0.3, "alone it is a source"


@pytest.mark.parametrize("wind", [0.0, 1.0])
@pytest.mark.parametrize("out_at", [np.inf, 2.0])
def test_the_source_is_found_where_smoke_drifts_and_where_it_goes_out(wind: float, out_at: float) -> None:
    source = (0.7, -0.9, 2.0)
    for direction in ((1.0, 0.0), (-0.6, 0.8)):
        found = source_point(film([source], wind * np.array(direction), out_at=out_at).__getitem__, VIEWS)
        assert np.linalg.norm(found[:2] - source[:2]) < 0.3
        assert -0.8 < found[2] - source[2] < 0.2, "the foot is a little below the middle"


def test_smoke_that_wind_carries_to_the_camera_and_below_its_source_in_the_picture() -> None:
    source = (-1.5, 1.2, 3.0)
    views = [
        view_at(orbit_cameras(replace(ORBIT, elevation=35.0), width=WIDTH, height=HEIGHT, fps=FPS, num_frames=NUM_FRAMES), t)
        for t in range(NUM_FRAMES)
    ]
    depths = film([source], 4.0 * TOWARDS, views)
    lowest = max(np.flatnonzero(depth.max(axis=1) > 0.1)[-1] for depth in depths)
    assert lowest > views[0].project(np.array([source]))[0][0, 1] + 10
    assert np.linalg.norm((foot_point(depths.__getitem__, views) - source)[:2]) > 1.5
    assert np.linalg.norm((source_point(depths.__getitem__, views) - source)[:2]) < 0.7


def test_of_several_sources_it_is_the_middle() -> None:
    found = source_point(film([(-1.5, -1.0, 2.0), (1.5, 1.0, 2.0)], np.array([0.3, 0.1])).__getitem__, VIEWS)
    np.testing.assert_allclose(found[:2], 0.0, atol=0.4)


@pytest.mark.parametrize("degrees", [0.5, 8.0, 20.0])
def test_a_camera_that_turns_little_finds_the_source_on_its_ray(degrees: float) -> None:
    """As far away as the pictures and the world's origin say together."""
    source = (0.4, -0.3, 2.0)
    orbit = replace(ORBIT, azimuth_stop=ORBIT.azimuth_start + degrees)
    given = orbit_cameras(orbit, width=WIDTH, height=HEIGHT, fps=FPS, num_frames=NUM_FRAMES)
    views = [view_at(given, frame) for frame in range(NUM_FRAMES)]
    scene = make_scene([layer_of(depth) for depth in film([source], np.array([0.3, 0.2]), views)], given)
    seen, real = (views[12].project(point[None])[0][0] for point in (scene.anchor, np.array(source)))
    assert abs(seen[0] - real[0]) < 2.5  # px
    assert np.linalg.norm(scene.anchor - source) < 1.0


def flickering(source: tuple[float, float, float], views: list[View], draw: np.random.Generator) -> list[np.ndarray]:
    """Optical depths [H, W] of puffs of unequal mass that leave from a little beside a source, as smoke in truth does."""
    births = np.arange(-5.0, 1.0, 0.15)
    beside, masses = draw.normal(0.0, 0.15, (len(births), 3)), draw.lognormal(0.0, 0.5, len(births))
    return [
        np.sum(
            [
                mass * film([tuple(source + off)], np.array([0.5, 0.3]), [view], ages=[frame / 15 - birth])[0]
                for birth, off, mass in zip(births, beside, masses, strict=True)
                if 0.0 <= frame / 15 - birth < 5.0
            ],
            axis=0,
        )
        for frame, view in enumerate(views)
    ]


def test_a_short_clip_s_source_is_no_matter_of_chance() -> None:
    """Seven degrees leave its depth open by a metre or two; in pictures half as large smoke stands out most elsewhere."""
    source, half = (0.7, -0.9, 2.0), (WIDTH // 2, HEIGHT // 2)
    orbit = replace(ORBIT, azimuth_stop=ORBIT.azimuth_start + 7.0)
    given = orbit_cameras(orbit, width=WIDTH, height=HEIGHT, fps=15.0, num_frames=14)
    views = [view_at(given, frame) for frame in range(14)]
    smaller = [resized(view, half) for view in views]
    errors, changes = [], []
    for seed in range(6):
        depths = flickering(source, views, np.random.default_rng(seed))
        found = source_point(depths.__getitem__, views)
        small = [cv2.resize(depth, half, interpolation=cv2.INTER_AREA) for depth in depths]
        errors.append(np.linalg.norm((found - source)[:2]))
        changes.append(np.linalg.norm(found - source_point(small.__getitem__, smaller)))
    assert np.mean(errors) < 1.3
    assert np.mean(changes) < 0.5


def test_a_camera_that_stands_still_tells_no_depth() -> None:
    given = still_cameras(ORBIT, turned=0.0, width=WIDTH, height=HEIGHT, fps=FPS)
    depths = film([(0.4, -0.3, 2.0)], np.zeros(2), [view_at(given, 0)])
    np.testing.assert_array_equal(make_scene([layer_of(depths[0])], given).anchor, standing_point(view_at(given, 0)))


def test_pictures_refute_a_world_that_begins_elsewhere() -> None:
    depths = film([(0.4, -0.3, 2.0)], np.array([0.4, 0.0]))
    expected = source_point(depths.__getitem__, VIEWS)
    for away in ([0.0, 25.0, 0.0], [0.0, -7.0, 0.0], [3e5, 1e6, -2e5]):
        shift = np.eye(4)
        shift[:3, 3] = np.negative(away)
        moved = [replace(view, camera_to_world=shift @ view.camera_to_world) for view in VIEWS]
        np.testing.assert_allclose(source_point(depths.__getitem__, moved) + away, expected, atol=0.4)


def test_a_tilted_world_has_its_source_tilted() -> None:
    depths = film([(0.4, -0.3, 2.0)], np.array([0.4, 0.0]))
    leaning = tilted(CAMERAS, 25.0)
    found = source_point(depths.__getitem__, [view_at(leaning, frame) for frame in range(NUM_FRAMES)])
    np.testing.assert_allclose(turn(25.0)[:3, :3].T @ found, source_point(depths.__getitem__, VIEWS), atol=0.02)


def test_without_smoke_it_stands_where_smoke_usually_does() -> None:
    nothing = [layer_of(np.zeros((HEIGHT, WIDTH)))] * NUM_FRAMES
    found = source_point(lambda frame: optical_depth(nothing[frame]), VIEWS)
    np.testing.assert_array_equal(found, standing_point(VIEWS[0]))
