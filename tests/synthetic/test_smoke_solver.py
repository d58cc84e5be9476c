"""The solver of the benchmark: projection, advection, conservation, forces, buoyant scaling, determinism."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from synthetic.scenes import AIR_TEMPERATURE, GRAVITY, SCENES, Obstacle, SmokeScene, Source
from synthetic.solver.fields import Grid, centred_velocity, divergence, optical_mass
from synthetic.solver.forces import add_to_faces, buoyancy, vorticity_confinement
from synthetic.solver.momentum import advect_velocity, maccormack
from synthetic.solver.noise import SourceNoise
from synthetic.solver.pressure import open_faces_of, project
from synthetic.solver.simulation import SmokeState, advance, begin, prepare, run
from synthetic.solver.transport import courant_number, transport


def random_velocity(shape: tuple[int, int, int], *, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    random = np.random.default_rng(seed)
    nx, ny, nz = shape
    shapes = ((nx + 1, ny, nz), (nx, ny + 1, nz), (nx, ny, nz + 1))
    return tuple(random.normal(size=one).astype(np.float32) for one in shapes)  # type: ignore[return-value]


def gradient_size(velocity: np.ndarray, voxel_size: float) -> float:
    """Root mean square of all nine derivatives of a velocity in cell centres, 1/s."""
    parts = [np.gradient(velocity[..., axis], voxel_size) for axis in range(3)]
    return float(np.sqrt(sum((part**2).mean() for row in parts for part in row)))


@pytest.mark.parametrize("has_obstacle", [False, True])
def test_projection_leaves_no_divergence(has_obstacle: bool) -> None:
    shape = (14, 11, 17)
    solid = np.zeros(shape, bool)
    solid[4:8, 3:7, 5:9] = has_obstacle
    faces = open_faces_of(solid) if has_obstacle else None
    velocity = random_velocity(shape, seed=3)
    u, v, w = project(velocity, open_faces=faces)
    left = divergence(u, v, w, voxel_size=0.1)
    before = divergence(*velocity, voxel_size=0.1)
    assert np.abs(left).max() < 1e-5 * np.sqrt((before**2).mean())
    assert np.all(w[:, :, 0] == 0)
    if has_obstacle:
        assert np.all(u[4:9, 3:7, 5:9] == 0) and np.all(v[4:8, 3:8, 5:9] == 0) and np.all(w[4:8, 3:7, 5:10] == 0)


def test_projection_is_a_projection() -> None:
    """Applying it twice changes nothing, and what it removes is orthogonal to what it keeps."""
    velocity = random_velocity((9, 8, 10), seed=4)
    velocity[2][:, :, 0] = 0
    once = project(velocity)
    twice = project(once)
    for a, b in zip(once, twice, strict=True):
        np.testing.assert_allclose(a, b, atol=2e-6)
    # Weighted like the gradient's adjoint: an outer open face belongs to half a cell.
    product, size = 0.0, 0.0
    for axis, (kept, given) in enumerate(zip(once, velocity, strict=True)):
        weight = np.ones_like(kept, np.float64)
        ends = [slice(None)] * 3
        for end in (0, -1):
            ends[axis] = end
            weight[tuple(ends)] = 0.5
        product += float((weight * kept * (given - kept)).sum())
        size += float((weight * kept * kept).sum())
    assert abs(product) < 1e-5 * size


def test_projection_keeps_a_uniform_wind() -> None:
    nx, ny, nz = 8, 7, 9
    u, v, w = project(
        (
            np.full((nx + 1, ny, nz), 3, np.float32),
            np.full((nx, ny + 1, nz), -2, np.float32),
            np.zeros((nx, ny, nz + 1), np.float32),
        )
    )
    np.testing.assert_allclose(u, 3, atol=1e-6)
    np.testing.assert_allclose(v, -2, atol=1e-6)
    np.testing.assert_allclose(w, 0, atol=1e-6)


def _uniform(shape: tuple[int, int, int], speed: tuple[float, float, float]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    nx, ny, nz = shape
    shapes = ((nx + 1, ny, nz), (nx, ny + 1, nz), (nx, ny, nz + 1))
    return tuple(np.full(one, value, np.float32) for one, value in zip(shapes, speed, strict=True))  # type: ignore[return-value]


def _blob(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A smooth bump in a box of 1 x 1."""
    return np.exp(-((x - 0.0) ** 2 + y**2) / 0.0128)


def _advection_error(count: int, *, is_scalar: bool) -> float:
    """Mean error after a bump has crossed a third of the box obliquely; the step shrinks with the cell."""
    h = 1.0 / count
    speed = (1.0, 0.6, 0.0)
    shape = (count, count, 4)
    velocity = _uniform(shape, speed)
    centres = (np.arange(count) + 0.5) * h
    faces = np.arange(count + 1) * h
    num_steps, step = count // 4, 4.0 / 3.0 * h
    time = num_steps * step
    if is_scalar:
        x, y, _ = np.meshgrid(centres, centres, np.arange(4), indexing="ij")
    else:
        x, y, _ = np.meshgrid(faces, centres, np.arange(4), indexing="ij")
    field = _blob(x - 0.33, y - 0.4).astype(np.float32)
    for _ in range(num_steps):
        if is_scalar:
            field, _ = transport(field, velocity, time_step=step, voxel_size=h)
        else:
            field = maccormack(field, 0, *velocity, np.zeros(4, np.float32), np.float32(step / h))
    expected = _blob(x - 0.33 - speed[0] * time, y - 0.4 - speed[1] * time)
    return float(np.abs(field - expected).mean())


@pytest.mark.parametrize(("is_scalar", "least_order"), [(False, 1.7), (True, 1.9)])
def test_advection_converges_at_second_order(is_scalar: bool, least_order: float) -> None:
    errors = [_advection_error(count, is_scalar=is_scalar) for count in (32, 64, 128)]
    orders = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    assert orders[-1] > least_order


def test_transport_keeps_bounds_and_mass() -> None:
    """In a flow without divergence: nothing over- or undershoots, no mass is lost uncounted."""
    shape = (12, 13, 14)
    velocity = project(random_velocity(shape, seed=5))
    h = 0.2
    field = np.zeros(shape, np.float32)
    field[4:8, 4:9, 3:9] = np.random.default_rng(1).uniform(0, 2, size=(4, 5, 6))
    mass, left = optical_mass(field, voxel_size=h), 0.0
    for _ in range(20):
        field, out = transport(field, velocity, time_step=0.05, voxel_size=h)
        left += out
    assert left > 0.01 * mass
    assert optical_mass(field, voxel_size=h) + left == pytest.approx(mass, rel=1e-5)
    assert field.min() > -1e-5 and field.max() < 2.0 + 1e-5


def test_transport_of_ones_is_exact_away_from_the_open_sides() -> None:
    shape = (24, 24, 24)
    velocity = tuple(component * np.float32(0.2) for component in project(random_velocity(shape, seed=6)))
    flat, _ = transport(np.ones(shape, np.float32), velocity, time_step=0.01, voxel_size=0.1)  # type: ignore[arg-type]
    # One substep of three stages reaches six cells at most.
    assert courant_number(*velocity) * 0.1 < 0.6  # type: ignore[arg-type]
    np.testing.assert_allclose(flat[7:-7, 7:-7, :-7], 1, atol=2e-6)


def _flux_by_hand(speed: float, a: float, b: float, c: float, d: float) -> float:
    """Koren 1993 eq. 22, as it is written there."""
    if speed < 0:
        a, b, c, d = d, c, b, a
    behind, ahead = b - a, c - b
    if behind * ahead <= 0:
        return speed * b
    r = ahead / behind
    return speed * (b + 0.5 * max(0.0, min(2 * r, min((1 + 2 * r) / 3, 2.0))) * behind)


def _rate_by_hand(field: np.ndarray, velocity: tuple[np.ndarray, ...], step: float) -> np.ndarray:
    """What flows into each cell, face by face."""
    rate = np.zeros(field.shape)
    for axis, component in enumerate(velocity):
        speeds, cells, rates = (np.moveaxis(part, axis, 0) for part in (component, field, rate))
        count = len(cells)
        for at in np.ndindex(speeds.shape):
            face, rest = at[0], at[1:]
            a, b, c, d = (float(cells[(min(max(face + by, 0), count - 1), *rest)]) for by in (-2, -1, 0, 1))
            speed = float(speeds[at])
            flux = max(speed, 0) * b if face == count else min(speed, 0) * c if face == 0 else _flux_by_hand(speed, a, b, c, d)
            if face > 0:
                rates[(face - 1, *rest)] -= step * flux
            if face < count:
                rates[at] += step * flux
    return rate


@pytest.mark.parametrize("shape", [(5, 6, 7), (1, 2, 9)])
def test_transport_is_what_the_formulas_say_at_every_cell(shape: tuple[int, int, int]) -> None:
    velocity = random_velocity(shape, seed=8)
    field = np.maximum(np.random.default_rng(4).normal(size=shape), 0).astype(np.float32)
    moved, _ = transport(field, velocity, time_step=0.005, voxel_size=0.1)
    assert courant_number(*velocity) * 0.05 < 0.6  # one substep
    first = field + _rate_by_hand(field, velocity, 0.05)
    second = 0.75 * field + 0.25 * (first + _rate_by_hand(first, velocity, 0.05))
    expected = field / 3 + 2 / 3 * (second + _rate_by_hand(second, velocity, 0.05))
    np.testing.assert_allclose(moved, expected, atol=2e-6)


def test_still_air_moves_nothing() -> None:
    shape = (6, 7, 8)
    calm = _uniform(shape, (0, 0, 0))
    field = np.random.default_rng(2).uniform(size=shape).astype(np.float32)
    moved, left = transport(field, calm, time_step=1.0, voxel_size=0.1)
    np.testing.assert_allclose(moved, field, rtol=3e-7)
    assert left == 0
    for component in advect_velocity(calm, np.zeros((8, 2), np.float32), cells=1.0):
        assert np.all(component == 0)


def test_maccormack_makes_no_new_extremes() -> None:
    shape = (10, 10, 10)
    velocity = project(random_velocity(shape, seed=7))
    field = np.random.default_rng(3).uniform(-1, 1, size=velocity[0].shape).astype(np.float32)
    moved = maccormack(field, 0, *velocity, np.zeros(10, np.float32), np.float32(1.3))
    assert moved.min() >= -1 and moved.max() <= 1 and np.isfinite(moved).all()


def test_wind_flows_in_from_outside() -> None:
    shape = (8, 6, 5)
    velocity = _uniform(shape, (2.0, 0.0, 0.0))
    wind = np.zeros((5, 2), np.float32)
    wind[:, 0] = np.arange(5)
    u, _, _ = advect_velocity(velocity, wind, cells=1.0)
    np.testing.assert_allclose(u[0], np.broadcast_to(np.arange(5), (6, 5)))
    np.testing.assert_allclose(u[3:], 2.0)


def test_buoyancy_by_hand() -> None:
    hot = np.full((2, 2, 2), AIR_TEMPERATURE, np.float32)
    np.testing.assert_allclose(buoyancy(hot), GRAVITY, rtol=1e-6)
    assert buoyancy(np.zeros(1, np.float32))[0] == 0


def test_confinement_pushes_around_a_swirl() -> None:
    """A round swirl about z: the force points along the swirl's sense; in uniform flow there is none."""
    count, h = 24, 0.1
    axis = (np.arange(count) - 11.5) * h
    x, y, _ = np.meshgrid(axis, axis, axis, indexing="ij")
    strength = np.exp(-(x**2 + y**2) / 0.18)
    swirl = np.stack([-y * strength, x * strength, np.zeros_like(x)], axis=-1).astype(np.float32)
    force = vorticity_confinement(swirl, strength=0.5, voxel_size=h)
    ring = (np.hypot(x, y) > 0.1) & (np.hypot(x, y) < 0.3)
    assert np.all((force * swirl).sum(axis=-1)[ring] > 0)
    doubled = vorticity_confinement(swirl, strength=1.0, voxel_size=h)
    np.testing.assert_allclose(doubled, 2 * force, rtol=1e-5)
    assert np.all(vorticity_confinement(np.ones((6, 6, 6, 3), np.float32), strength=1.0, voxel_size=h) == 0)


def test_forces_reach_the_inner_faces() -> None:
    velocity = _uniform((4, 5, 6), (0, 0, 0))
    push = np.zeros((4, 5, 6, 3), np.float32)
    push[..., 2] = 3.0
    u, v, w = add_to_faces(velocity, push, time_step=0.5)
    assert np.all(u == 0) and np.all(v == 0)
    np.testing.assert_allclose(w[:, :, 1:-1], 1.5)
    assert np.all(w[:, :, 0] == 0)


def test_noise_has_unit_variance_and_no_divergence() -> None:
    noise = SourceNoise(seed=5, radius=0.5)
    positions = np.random.default_rng(0).uniform(-50, 50, size=(20000, 3))
    assert noise.flicker(positions, 0.3).var() == pytest.approx(1, rel=0.1)
    stirring = noise.stirring(positions, 0.3)
    assert (stirring**2).mean() == pytest.approx(1, rel=0.35)
    delta = 1e-5
    slopes = []
    for axis in range(3):
        shift = np.zeros(3)
        shift[axis] = delta
        slopes.append((noise.stirring(positions[:50] + shift, 0.3) - noise.stirring(positions[:50] - shift, 0.3)) / (2 * delta))
    total = sum(slope[:, axis] for axis, slope in enumerate(slopes))
    assert np.abs(total).max() < 1e-4 * max(np.abs(slope).max() for slope in slopes)


def small_scene(**changes: object) -> SmokeScene:
    source = Source(position=(0.0, 0.0, 0.6), radius=0.45, temperature=150.0, rise=0.0)
    scene = SmokeScene(name="small", purpose="a test", sources=(source,), size=(4.0, 4.0, 8.0), seed=3)
    return dataclasses.replace(scene, **changes)  # type: ignore[arg-type]


def simulate(scene: SmokeScene, *, seconds: float, voxel_size: float = 0.2, time_step: float = 1 / 40) -> SmokeState:
    simulation = prepare(scene, voxel_size=voxel_size, time_step=time_step)
    state = begin(simulation)
    for _ in range(round(seconds / time_step)):
        state = advance(simulation, state)
    return state


@pytest.mark.parametrize("obstacles", [(), (Obstacle(low=(-0.4, -0.4, 1.4), high=(0.6, 0.4, 2.2)),)])
def test_a_run_balances_mass_and_has_no_divergence(obstacles: tuple[Obstacle, ...]) -> None:
    """Long enough for smoke to leave through the sides: what was made is inside or left, within 1 % (it is far less)."""
    scene = small_scene(size=(3.2, 3.2, 4.8), wind=(3.0, 0.5), obstacles=obstacles)
    state = simulate(scene, seconds=2.0)
    inside = optical_mass(state.density, voxel_size=0.2)
    assert state.left > 0.02 * state.emitted
    assert abs(inside + state.left - state.emitted) < 1e-3 * state.emitted
    left_over = divergence(state.u, state.v, state.w, voxel_size=0.2)
    size = gradient_size(centred_velocity(state), 0.2)
    assert np.sqrt((left_over**2).mean()) < 1e-5 * size
    assert state.density.min() > -1e-4
    if obstacles:
        assert state.density[7:10, 7:9, 8:10].max() < 1e-3  # the middle of the box stays clean


def heat_height(state: SmokeState, voxel_size: float) -> float:
    """Height of the centre of all heat, m."""
    profile = state.temperature.sum(axis=(0, 1), dtype=np.float64)
    return float((profile * (np.arange(profile.size) + 0.5)).sum() / profile.sum()) * voxel_size


def thermal_heights(*, temperature: float, time_step: float, num_steps: int) -> np.ndarray:
    """Rise of a ball of hot air released at rest, m, after every tenth step."""
    voxel_size, radius = 0.2, 0.5
    source = dataclasses.replace(small_scene().sources[0], stop=0.0)
    scene = small_scene(sources=(source,), size=(5.0, 5.0, 10.0), cooling=1e9, confinement=0.0)
    simulation = prepare(scene, voxel_size=voxel_size, time_step=time_step)
    x, y, z = np.meshgrid(*simulation.grid.centres(), indexing="ij")
    noise = SourceNoise(seed=8, radius=0.6).flicker(np.stack([x, y, z], axis=-1), 0.0)
    distance = np.sqrt(x**2 + y**2 + (z - 1.0) ** 2)
    ball = np.clip((radius - distance) / voxel_size + 0.5, 0, 1) * (1 + 0.5 * noise)
    state = dataclasses.replace(begin(simulation), temperature=(temperature * ball).astype(np.float32))
    start, heights = heat_height(state, voxel_size), []
    for count in range(1, num_steps + 1):
        state = advance(simulation, state)
        if count % 10 == 0:
            heights.append(heat_height(state, voxel_size) - start)
    return np.array(heights)


def test_a_thermal_rises_as_the_square_root_of_time() -> None:
    """A given amount of heat rises as z ~ B^1/4 t^1/2 (Scorer 1957): once it has turned over, z^2 grows evenly."""
    heights = thermal_heights(temperature=600.0, time_step=1 / 20, num_steps=80)
    growth = np.diff(heights**2)[2:]
    assert growth.std() < 0.1 * growth.mean()
    speed = np.diff(heights)[2:]
    assert speed[-1] < 0.7 * speed[0]  # at a constant speed z^2 would grow ever faster


def test_a_cooler_thermal_is_the_same_thermal_slower() -> None:
    """By dimensions alone: a quarter of the buoyancy does the same in twice the time (t ~ B^-1/2)."""
    hot = thermal_heights(temperature=300.0, time_step=1 / 20, num_steps=20)
    cool = thermal_heights(temperature=75.0, time_step=1 / 10, num_steps=20)
    np.testing.assert_allclose(cool, hot, rtol=1e-3)


def test_same_seed_same_bytes_other_seed_other_smoke() -> None:
    states = [simulate(small_scene(seed=seed), seconds=0.4) for seed in (3, 3, 4)]
    for name in ("density", "temperature", "u", "v", "w"):
        assert getattr(states[0], name).tobytes() == getattr(states[1], name).tobytes()
    assert states[0].density.tobytes() != states[2].density.tobytes()


def test_frames_come_at_their_times() -> None:
    simulation = prepare(small_scene(warm_up=0.2), voxel_size=0.4, time_step=1 / 20)
    times = [state.time for state in run(simulation, num_frames=3, fps=10)]
    np.testing.assert_allclose(times, [0.2, 0.3, 0.4])
    with pytest.raises(ValueError, match="divide"):
        next(run(simulation, num_frames=2, fps=30))


def test_a_source_starts_and_stops() -> None:
    source = dataclasses.replace(small_scene().sources[0], start=0.2, stop=0.4)
    scene = small_scene(sources=(source,))
    assert simulate(scene, seconds=0.2, voxel_size=0.4).emitted == 0
    middle, late = simulate(scene, seconds=0.4, voxel_size=0.4), simulate(scene, seconds=0.8, voxel_size=0.4)
    assert middle.emitted > 0
    assert late.emitted == pytest.approx(middle.emitted)


def test_bad_settings_are_refused() -> None:
    with pytest.raises(ValueError, match="positive"):
        prepare(small_scene(), voxel_size=0.0, time_step=0.1)
    with pytest.raises(ValueError, match="4 cells"):
        Grid(nx=3, ny=9, nz=9, voxel_size=0.1, origin=(0, 0, 0))
    outside = small_scene(sources=(Source(position=(0, 0, 30.0), radius=0.5),))
    simulation = prepare(outside, voxel_size=0.4, time_step=0.1)
    with pytest.raises(ValueError, match="outside"):
        advance(simulation, begin(simulation))


def test_every_scene_fits_its_box() -> None:
    for scene in SCENES.values():
        simulation = prepare(scene, voxel_size=0.5, time_step=1 / 20)
        state = begin(simulation)
        for _ in range(2):
            state = advance(simulation, state)
        assert all(np.isfinite(getattr(state, name)).all() for name in ("density", "temperature", "u", "v", "w"))
