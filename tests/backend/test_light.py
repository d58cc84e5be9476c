"""The clip's light from the shading of its smoke: found where it is, none where there is none."""

from __future__ import annotations

from dataclasses import asdict, replace

import numpy as np
import pytest

from backend.contract.light import Light, parse_light
from backend.field.rays import optical_depth
from backend.field.shadow import depth_towards
from backend.fit.light import USUAL_ANISOTROPY, Shot, evenly, find_light
from backend.geometry.camera import View
from backend.geometry.lattice import Lattice
from backend.io.particles import ParticleFrame
from backend.render.voxelize import voxelize

LATTICE = Lattice(origin=(-2.0, -2.0, -3.0), voxel_size=0.2, shape=(21, 21, 31))
SUN, SKY = np.array([0.8, 0.7, 0.5]), np.array([0.1, 0.12, 0.2])


def smoke(seed: int, num: int = 900) -> ParticleFrame:
    """Three lumps of thick smoke, somewhere else in each frame."""
    random = np.random.default_rng(seed)
    middles = random.uniform([-0.8, -0.8, -1.6], [0.8, 0.8, 1.6], (3, 3))
    return ParticleFrame(
        positions=middles[random.integers(0, 3, num)] + random.normal(0.0, 0.45, (num, 3)),
        velocities=np.zeros((num, 3), np.float32),
        scales=np.full(num, 0.2, np.float32),
        optical_masses=np.full(num, 0.02, np.float32),
        colors=np.full((num, 3), 0.5, np.float32),
        ids=np.arange(num),
    )


def camera(degrees: float) -> View:
    angle = np.radians(degrees)
    away = np.array([-np.cos(angle), -np.sin(angle), 0.0])
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([np.cross(away, [0.0, 0.0, 1.0]), [0.0, 0.0, -1.0], away], axis=1)
    matrix[:3, 3] = -12.0 * away
    return View(width=48, height=72, fx=110.0, fy=110.0, cx=24.0, cy=36.0, camera_to_world=matrix)


def shot(seed: int, direction: np.ndarray | None, degrees: float, *, anisotropy: float = USUAL_ANISOTROPY) -> Shot:
    """A frame as a sun and an even sky show it; None: smoke of one colour. Each pixel shows what its ray gathers, near smoke
    before far smoke, on slabs of the lattice: not the way in which the fit does it."""
    particles, view = smoke(seed), camera(degrees)
    density = np.ascontiguousarray(voxelize(particles, LATTICE)["density"], np.float32)
    if direction is None:
        light = np.full((*density.shape, 3), 0.4)
    else:
        reached = np.mean([np.exp(-0.7 * depth_towards(density, LATTICE, way)) for way in evenly(40) if way[2] > 0], axis=0)
        sun = SUN * (1 - anisotropy**2) / (1 + anisotropy**2 + 2 * anisotropy * direction @ view.position / 12.0) ** 1.5
        light = np.exp(-0.7 * depth_towards(density, LATTICE, direction))[..., None] * sun + reached[..., None] * SKY
    before = np.exp(-depth_towards(density, LATTICE, view.position / np.linalg.norm(view.position)))
    emitted = [optical_depth(np.ascontiguousarray(density * before * light[..., c], np.float32), LATTICE, view) for c in range(3)]
    gathered = optical_depth(np.ascontiguousarray(density * before, np.float32), LATTICE, view)
    opacity = 1.0 - np.exp(-optical_depth(density, LATTICE, view))
    color = np.stack(emitted, axis=-1) / np.maximum(gathered, 1e-6)[..., None]
    return Shot(particles=particles, view=view, layer=np.concatenate([color * opacity[..., None], opacity[..., None]], axis=-1))


@pytest.mark.parametrize(("azimuth", "elevation"), [(190.0, 30.0), (40.0, 60.0)])
def test_the_sun_is_found_where_it_stands(azimuth: float, elevation: float) -> None:
    a, e = np.radians(azimuth), np.radians(elevation)
    direction = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    found = find_light([shot(seed, direction, 10.0 * seed) for seed in range(4)])
    assert found is not None
    assert np.degrees(np.arccos(np.array(found.direction) @ direction)) < 8.0
    assert found.explained > 0.8
    assert found.doubt_degrees < 25.0
    np.testing.assert_allclose(found.sun, SUN, rtol=0.15)
    assert found.ambient[2] > found.ambient[0]  # the sky's hue is not the sun's


@pytest.mark.parametrize("anisotropy", [0.0, 0.25, 0.5])
def test_how_far_light_goes_on_is_told_by_a_camera_that_goes_around(anisotropy: float) -> None:
    direction = np.array([-0.6, 0.64, 0.48])
    found = find_light([shot(seed, direction, 25.0 * seed, anisotropy=anisotropy) for seed in range(6)])
    assert found is not None
    assert abs(found.anisotropy - anisotropy) < 0.1, found.anisotropy
    assert 0.6 < found.sun_share < 1.0


def test_a_still_camera_tells_nothing_of_it() -> None:
    direction = np.array([-0.6, 0.64, 0.48])
    for anisotropy in (0.0, 0.5):
        found = find_light([shot(seed, direction, 0.0, anisotropy=anisotropy) for seed in range(4)])
        assert found is not None
        assert found.anisotropy == pytest.approx(USUAL_ANISOTROPY, abs=0.06)


def test_smoke_of_one_colour_shows_no_light() -> None:
    assert find_light([shot(seed, None, 10.0 * seed) for seed in range(4)]) is None


def test_what_is_not_shading_is_no_light() -> None:
    """Stripes that stay on the picture whatever smoke there is: some direction fits some of it, and the proof refuses."""
    stripes = 0.3 + 0.2 * np.sign(np.sin(np.arange(48) * 0.9))[None, :, None]
    shots = [shot(seed, None, 10.0 * seed) for seed in range(4)]
    striped = [replace(s, layer=np.concatenate([s.layer[..., 3:] * stripes.repeat(3, -1), s.layer[..., 3:]], -1)) for s in shots]
    assert find_light(striped) is None


def test_too_little_to_tell() -> None:
    """No frame, one frame, black frames, a handful of particles: no light, no complaint."""
    lit = shot(0, np.array([0.0, 0.0, 1.0]), 0.0)
    black = replace(lit, layer=np.zeros_like(lit.layer))
    few = replace(lit, particles=smoke(0, num=3))
    assert find_light([]) is None
    for shots in ([lit], [black, black, black], [few, few]):
        assert find_light(shots) is None


def test_a_light_survives_its_own_text() -> None:
    light = Light(
        direction=(0.6, 0.0, 0.8), sun=(1.0, 0.9, 0.8), ambient=(0.0, 0.1, 0.2), softness=0.7, explained=0.8, doubt_degrees=9.0,
        anisotropy=0.2, sun_share=0.9,
    )  # fmt: skip
    assert parse_light(asdict(light)) == light
    for name, value in (
        ("direction", (0.0, 0.0, 0.0)),
        ("sun", (-1.0, 0.0, 0.0)),
        ("ambient", (1.0,)),
        ("softness", float("nan")),
        ("anisotropy", 1.0),
        ("sun_share", 1.1),
    ):
        with pytest.raises(ValueError):
            parse_light({**asdict(light), name: value})
    older = {name: value for name, value in asdict(light).items() if name not in ("anisotropy", "sun_share")}
    assert parse_light(older) == replace(light, anisotropy=0.0, sun_share=0.0), "files of before these were found"
    with pytest.raises(KeyError):
        parse_light({})
