"""The fluid step: forces by hand, projection against slow loops, invariants, extremes, determinism."""

from __future__ import annotations

from dataclasses import replace

import numba
import numpy as np
import pytest

from backend.physics import fluid as fluids
from backend.physics import solver as solver_parts
from backend.physics.fluid import FluidParameters, FluidState, derive_parameters, step
from backend.physics.kernels import POLY6
from tests.reference import fluid_loops


def state_of(positions, velocities=None, *, ids=None):
    positions = np.asarray(positions, np.float64).reshape(-1, 3)
    num = len(positions)
    return FluidState(
        positions=positions,
        velocities=np.zeros((num, 3)) if velocities is None else np.asarray(velocities, np.float64),
        masses=np.linspace(1.0, 2.0, num),
        ids=np.arange(num) if ids is None else np.asarray(ids),
        born=np.zeros(num, np.int32),
    )


def cloud(num=400, *, seed=0, speed=0.0, squeeze=1.0):
    random = np.random.default_rng(seed)
    return state_of(squeeze * random.random((num, 3)), speed * random.normal(size=(num, 3)))


def energy(state):
    return float(np.square(state.velocities).sum())


def overdensity(state, parameters):
    density = fluids.number_density(state.positions, parameters.smoothing_length)
    return float(np.maximum(density / parameters.rest_density - 1.0, 0.0).mean())


# -- forces ------------------------------------------------------------------------------------------------------------


def test_one_particle_by_hand():
    """v1 = (v0 + dt (b + k w)) / (1 + k dt), x1 = x0 + dt v1."""
    parameters = FluidParameters(
        smoothing_length=10.0, rest_density=1.0, buoyancy=(0.0, 0.0, 3.0), wind=(4.0, 0.0, 0.0), drag=2.0
    )
    after, report = step(state_of([[1.0, 2.0, 3.0]], [[0.0, 1.0, 0.0]]), parameters, 0.5)
    np.testing.assert_allclose(after.velocities, [[2.0, 0.5, 0.75]], rtol=1e-15)
    np.testing.assert_allclose(after.positions, [[2.0, 2.25, 3.375]], rtol=1e-15)
    assert (report.substeps, report.num_clamped, report.is_limited) == (1, 0, False)


def test_drag_leads_to_the_wind():
    parameters = FluidParameters(smoothing_length=1.0, rest_density=1.0, wind=(0.3, 0.0, -0.1), drag=1e30)
    after, _ = step(state_of([[0.0, 0.0, 0.0]], [[0.2, 0.2, 0.2]]), parameters, 1.0)
    np.testing.assert_allclose(after.velocities, [[0.3, 0.0, -0.1]], rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("drag", [3.0, 1e30])
def test_surface_drag_by_hand(drag):
    """A lone particle has rho = W(0); at half the rest density it feels half the drag. Inside dense smoke there is none."""
    parameters = FluidParameters(smoothing_length=1.0, rest_density=2.0 * POLY6, surface_drag=drag, wind=(0.2, 0.0, 0.0))
    after, _ = step(state_of([[0.0, 0.0, 0.0]], [[0.0, 0.1, 0.0]]), parameters, 0.5)
    slowed = 1.0 + 0.5 * 0.5 * drag
    np.testing.assert_allclose(after.velocities, [[0.2 * (1.0 - 1.0 / slowed), 0.1 / slowed, 0.0]], atol=1e-15)
    dense = replace(parameters, rest_density=0.5 * POLY6, tensile_strength=0.0)
    after, _ = step(state_of([[0.0, 0.0, 0.0]], [[0.0, 0.1, 0.0]]), dense, 0.5)
    np.testing.assert_allclose(after.velocities, [[0.0, 0.1, 0.0]], atol=1e-15)


def test_substeps_and_limit_are_reported():
    parameters = FluidParameters(smoothing_length=1.0, rest_density=1.0, max_substeps=4)
    for speed, substeps, is_limited in [(0.4, 1, False), (0.41, 2, False), (1.6, 4, False), (1.7, 4, True)]:
        after, report = step(state_of([[0.0, 0.0, 0.0]], [[speed, 0.0, 0.0]]), parameters, 1.0)
        assert (report.substeps, report.is_limited) == (substeps, is_limited)
        assert after.positions[0, 0] == pytest.approx(min(speed, 1.6), rel=1e-12)


# -- projection --------------------------------------------------------------------------------------------------------


def test_sums_against_slow_loops():
    state = cloud(60)
    length, rest_density = 0.5, 30.0
    solver = solver_parts.Solver(state.positions / length, state.ids, rest_density=rest_density * length**3)
    solver.constrain(pulls=False)
    np.testing.assert_allclose(solver.densities / length**3, fluid_loops.densities(state.positions, length), rtol=1e-12)
    epsilon = solver_parts.EPSILON_SHARE * solver.squares_at_rest / length**2
    lambdas = fluid_loops.lambdas(state.positions, length, rest_density, epsilon)
    assert np.count_nonzero(lambdas) > 30
    np.testing.assert_allclose(solver.lambdas * length**2, lambdas, rtol=1e-10)
    tensile = 0.02 / solver.squares_at_rest * length**2
    parameters = FluidParameters(smoothing_length=length, rest_density=rest_density, tensile_strength=0.02)
    limit, solver_parts.MAX_SHIFT = solver_parts.MAX_SHIFT, 1e9  # without the limit, the formula alone
    try:
        solver.correct(parameters)
    finally:
        solver_parts.MAX_SHIFT = limit
    unlimited = fluid_loops.shifts(state.positions, length, rest_density, lambdas, tensile) * solver_parts.RELAXATION
    np.testing.assert_allclose(solver.shifts * length, unlimited, rtol=1e-9, atol=1e-12)


def test_squares_at_rest_match_random_points():
    """The closed form of the sum of squared gradients, against the sum over points at random."""
    positions = 8.0 * np.random.default_rng(6).random((20_000, 3)) - 4.0
    rest_density = 20_000 / 8.0**3
    centres = [position for position in positions if np.abs(position).max() < 1.5][:200]
    sums = []
    for centre in centres:
        near = positions[np.linalg.norm(positions - centre, axis=1) < 1.0]
        sums.append(sum(float(np.square(fluid_loops.spiky_gradient(centre - x, 1.0)).sum()) for x in near))
    solver = solver_parts.Solver(np.zeros((1, 3)), np.zeros(1, np.int64), rest_density=rest_density)
    assert solver.squares_at_rest == pytest.approx(np.mean(sums) / rest_density**2, rel=0.1)


def test_projection_reduces_overdensity():
    state = cloud(800, squeeze=0.85)
    parameters = derive_parameters(cloud(800).positions)
    before = overdensity(state, parameters)
    after, report = step(state, replace(parameters, solver_iterations=12), 0.04)
    assert before > 0.25 and report.overdensity == pytest.approx(before, rel=1e-9)
    assert overdensity(after, parameters) < 0.25 * before
    worse, _ = step(state, replace(parameters, solver_iterations=0), 0.04)
    assert overdensity(worse, parameters) == pytest.approx(before, rel=1e-9)


def test_overlap_is_undone_without_velocity():
    """Particles born into each other part, and none is shot away, however short the step."""
    state = cloud(300, squeeze=0.7)
    parameters = derive_parameters(cloud(300).positions)
    for dt in (1e-9, 1e-3, 1.0):
        after, _ = step(state, parameters, dt)
        assert np.abs(after.positions - state.positions).max() > 0.05 * parameters.smoothing_length
        assert energy(after) == 0.0


def test_compression_is_stopped():
    """Two halves run into each other: most of what would make them overlap is turned away."""
    state = cloud(1000)
    parameters = replace(derive_parameters(state.positions), solver_iterations=6)
    toward = np.where(state.positions[:, :1] < 0.5, 1.0, -1.0) * np.array([[1.0, 0.0, 0.0]])
    moving = replace(state, velocities=toward)
    free = replace(parameters, solver_iterations=0)
    kept = blocked = moving
    for _ in range(6):
        kept, _ = step(kept, free, 0.02)
        blocked, _ = step(blocked, parameters, 0.02)
    assert overdensity(blocked, parameters) < 0.3 * overdensity(kept, parameters)
    assert energy(blocked) < 0.8 * energy(moving)


def test_sparse_gas_is_left_alone():
    """Below rest density nothing pulls, unless asked."""
    state = cloud(200, speed=0.1)
    parameters = replace(derive_parameters(state.positions), tensile_strength=0.0)
    parameters = replace(parameters, rest_density=10.0 * parameters.rest_density)
    after, _ = step(state, parameters, 0.01)
    np.testing.assert_allclose(after.positions, state.positions + 0.01 * state.velocities, rtol=1e-13)
    pulled, _ = step(state, replace(parameters, pulls_when_sparse=True), 0.01)
    assert np.std(pulled.positions) < np.std(after.positions)


def test_parting_depends_on_ids_alone():
    """The same two particles in the other order move the same way."""
    parameters = FluidParameters(smoothing_length=1.0, rest_density=POLY6)
    one, _ = step(state_of(np.zeros((2, 3)), ids=[3, 8]), parameters, 0.1)
    other, _ = step(state_of(np.zeros((2, 3)), ids=[8, 3]), parameters, 0.1)
    assert np.linalg.norm(one.positions[0] - one.positions[1]) > 1e-3
    np.testing.assert_array_equal(one.positions, other.positions[::-1])


# -- invariants --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("extra", [{}, {"viscosity": 5.0}, {"pulls_when_sparse": True}, {"tensile_strength": 0.2}])
def test_momentum_and_centre_without_forces(extra):
    state = cloud(500, speed=0.3, squeeze=0.8)
    parameters = replace(derive_parameters(cloud(500).positions), **extra)
    after, report = step(state, parameters, 0.05)
    assert not report.is_limited
    np.testing.assert_allclose(after.velocities.sum(axis=0), state.velocities.sum(axis=0), atol=1e-11)
    centre = state.positions.mean(axis=0) + 0.05 * state.velocities.mean(axis=0)
    np.testing.assert_allclose(after.positions.mean(axis=0), centre, atol=1e-13)


def test_energy_never_grows_without_forces():
    state = cloud(400, speed=0.5, squeeze=0.7)
    parameters = replace(derive_parameters(cloud(400).positions), viscosity=1.0)
    for _ in range(50):
        after, _ = step(state, parameters, 0.02)
        assert energy(after) <= energy(state) * (1.0 + 1e-12)
        state = after


def test_common_velocity_changes_nothing():
    """Seen from a moving train, the fluid does the same."""
    state = cloud(300, speed=0.2, squeeze=0.8)
    parameters = derive_parameters(cloud(300).positions)
    train = np.array([0.5, -0.3, 0.2])
    after, report = step(state, parameters, 0.05)
    moved, moved_report = step(replace(state, velocities=state.velocities + train), parameters, 0.05)
    assert report.substeps == moved_report.substeps
    np.testing.assert_allclose(moved.positions, after.positions + 0.05 * train, atol=1e-12)
    np.testing.assert_allclose(moved.velocities, after.velocities + train, atol=1e-11)


def test_order_of_particles_does_not_matter():
    state = cloud(300, speed=0.2, squeeze=0.8)
    parameters = derive_parameters(cloud(300).positions)
    order = np.random.default_rng(5).permutation(300)
    names = ("positions", "velocities", "masses", "ids", "born")
    shuffled, _ = step(FluidState(**{name: getattr(state, name)[order] for name in names}), parameters, 0.05)
    after, _ = step(state, parameters, 0.05)
    np.testing.assert_array_equal(shuffled.ids, after.ids[order])
    np.testing.assert_allclose(shuffled.positions, after.positions[order], atol=1e-12)


def test_spinning_up():
    """Vorticity confinement adds to a vortex's energy and does not move its centre."""
    state = cloud(600)
    arm = state.positions - 0.5
    turning = np.stack([-arm[:, 1], arm[:, 0], np.zeros(600)], axis=1) * np.exp(-20.0 * (arm**2).sum(axis=1))[:, None]
    state = replace(state, velocities=turning)
    parameters = derive_parameters(state.positions)
    plain, _ = step(state, parameters, 0.04)
    confined, _ = step(state, replace(parameters, vorticity_confinement=2.0), 0.04)
    assert energy(confined) > 1.01 * energy(plain)


def test_viscosity_makes_neighbours_alike():
    state = cloud(500, speed=0.2)
    parameters = derive_parameters(state.positions)
    plain, _ = step(state, parameters, 0.02)
    blended, _ = step(state, replace(parameters, viscosity=50.0), 0.02)
    assert np.std(blended.velocities) < 0.7 * np.std(plain.velocities)


def test_same_bytes_for_any_number_of_threads():
    if numba.config.NUMBA_NUM_THREADS < 2:
        pytest.skip("numba was started with one thread")
    parameters = replace(derive_parameters(cloud(3000).positions), viscosity=1.0, vorticity_confinement=1.0)
    results = []
    for num_threads in (1, 2):
        numba.set_num_threads(num_threads)
        state = cloud(3000, speed=0.2, squeeze=0.9)
        for _ in range(3):
            state, _ = step(state, parameters, 0.04)
        results.append(state.positions.tobytes() + state.velocities.tobytes())
    numba.set_num_threads(numba.config.NUMBA_NUM_THREADS)
    assert results[0] == results[1]


# -- what is refused --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "bad",
    [
        {"smoothing_length": 0.0}, {"smoothing_length": np.nan}, {"rest_density": -1.0}, {"drag": -1.0}, {"drag": np.inf},
        {"buoyancy": (0.0, np.nan, 0.0)}, {"wind": (0.0, 0.0)}, {"max_substeps": 0}, {"solver_iterations": -1},
        {"tensile_exponent": 16}, {"viscosity": -0.1}, {"surface_drag": -1.0},
    ],
)  # fmt: skip
def test_bad_parameters_are_refused(bad):
    with pytest.raises(ValueError):
        FluidParameters(**{"smoothing_length": 1.0, "rest_density": 1.0, **bad})


def test_wrong_shapes_are_refused():
    with pytest.raises(ValueError, match="velocities"):
        replace(cloud(4), velocities=np.zeros((3, 3)))


# -- parameters from positions -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("spacing", [1e-3, 0.2, 50.0])
def test_lattice_is_measured_right(spacing):
    axis = spacing * np.arange(12.0)
    positions = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    parameters = derive_parameters(positions)
    assert parameters.smoothing_length == pytest.approx(2.2 * spacing, rel=0.01)
    assert parameters.rest_density * spacing**3 == pytest.approx(1.0, rel=0.05)


def test_lattice_is_nearly_at_rest():
    axis = 0.1 * np.arange(8.0)
    state = state_of(np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3))
    after, _ = step(state, replace(derive_parameters(state.positions), tensile_strength=0.0), 0.04)
    assert np.abs(after.positions - state.positions).max() < 0.003  # 3 % of the spacing
    assert energy(after) == 0.0


def test_random_points_are_measured_right():
    positions = np.random.default_rng(0).random((20_000, 3))
    assert fluids.typical_spacing(positions) == pytest.approx(20_000 ** (-1 / 3), rel=0.03)


def test_duplicates_do_not_shrink_the_spacing():
    positions = np.random.default_rng(0).random((500, 3))
    doubled = np.concatenate([positions] * 40)
    assert fluids.typical_spacing(doubled) == fluids.typical_spacing(positions)


def test_two_particles_are_enough():
    parameters = derive_parameters(np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]))
    assert 0.5 < parameters.smoothing_length < 10.0
