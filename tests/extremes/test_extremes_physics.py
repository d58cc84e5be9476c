"""The fluid at its limits: none and a million, all in one place, no time and too much of it, forces beyond all measure."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from backend.contract.errors import BackendError
from backend.physics import solver as solver_parts
from backend.physics.buoyancy import solve_buoyancy
from backend.physics.divergence import divergence
from backend.physics.fluid import FluidParameters, FluidState, derive_parameters, step
from backend.physics.fluid_gradient import rollout
from backend.physics.fluid_torch import step_torch
from backend.physics.kernels import POLY6
from backend.physics.neighbours import find_neighbours
from tests.extremes.draws import same_draws
from tests.reference.refusals import refuses

PART = "Physics"
pytestmark = pytest.mark.timeout(3600)  # of the whole ranges, on a busy core


def state_of(positions, velocities=None) -> FluidState:
    positions = np.asarray(positions, np.float64).reshape(-1, 3)
    num = len(positions)
    return FluidState(
        positions=positions,
        velocities=np.zeros((num, 3)) if velocities is None else np.asarray(velocities, np.float64),
        masses=np.linspace(1.0, 2.0, num),
        ids=np.arange(num),
        born=np.zeros(num, np.int32),
    )


def cloud(num, *, seed=0, speed=0.0, squeeze=1.0) -> FluidState:
    random = np.random.default_rng(seed)
    return state_of(squeeze * random.random((num, 3)), speed * random.normal(size=(num, 3)))


def energy(state) -> float:
    return float(np.square(state.velocities).sum())


def momentum_error(after, before) -> float:
    """Of the sum of velocities, relative to the sum of speeds."""
    lost = np.linalg.norm(after.velocities.sum(axis=0) - before.velocities.sum(axis=0))
    return float(lost / max(np.linalg.norm(before.velocities, axis=1).sum(), 1e-300))


def is_finite(state) -> bool:
    return bool(np.isfinite(state.positions).all() and np.isfinite(state.velocities).all())


def most_allowed(report, parameters) -> float:
    """m: how far a step may move a particle at most, however hard it is pushed."""
    shifts = parameters.solver_iterations * solver_parts.MAX_SHIFT
    return report.substeps * parameters.smoothing_length * (solver_parts.MAX_TRAVEL + shifts) * (1 + 1e-9)


# -- how many ----------------------------------------------------------------------------------------------------------


def test_any_number_of_particles(table):
    counts = [0, 1, 2, 3, 1000, 20_000] + ([1_000_000] if table.is_full else [])
    worst = 0.0
    for num in counts:
        state = cloud(num, speed=0.1, squeeze=0.9)
        spacing = max(num, 1) ** (-1 / 3)
        parameters = FluidParameters(smoothing_length=2.2 * spacing, rest_density=1 / spacing**3)
        after, report = step(replace(state, velocities=spacing * state.velocities), parameters, 0.5)
        assert after.positions.shape == (num, 3) and is_finite(after)
        assert report.substeps >= 1
        np.testing.assert_array_equal(after.masses, state.masses)
        worst = max(worst, momentum_error(after, replace(state, velocities=spacing * state.velocities)))
    table.row(
        "number of particles", tried=f"0, 1, 2, 3 to {max(counts):,}", happens="pushed apart; momentum only moves between them",
        measure="momentum lost / sum of speeds", worst=worst, bound=1e-10,
    )  # fmt: skip


def test_all_in_one_place(table):
    """However many coincide: they part, nothing is shot away, and their centre stays."""
    counts = [2, 12, 300] + ([3000] if table.is_full else [])
    worst = 0.0
    for num in counts:
        parameters = FluidParameters(smoothing_length=0.1, rest_density=3000.0, solver_iterations=4)
        state = state_of(np.full((num, 3), 0.5))
        for _ in range(5):
            before = state
            state, report = step(state, parameters, 0.02)
            moved = np.linalg.norm(state.positions - before.positions, axis=1).max()
            worst = max(worst, moved / most_allowed(report, parameters))
            assert energy(state) == 0.0
        assert len(np.unique(state.positions, axis=0)) == num
        assert np.linalg.norm(state.positions.mean(axis=0) - 0.5) < 0.3 * parameters.smoothing_length
    table.row(
        "all particles in one place", tried=f"2 to {max(counts):,}", happens="they part, without any speed",
        measure="way in a step / what a step allows", worst=worst, bound=1,
    )  # fmt: skip


def test_more_neighbours_than_memory_are_refused_before_it_is_asked_for(table):
    with pytest.raises(BackendError) as caught:
        find_neighbours(np.zeros((1_000_000, 3)), 0.1)
    assert caught.value.code == "particles_too_crowded"
    assert caught.value.hint.endswith(".")
    table.row(
        "pairs of neighbours", tried="a million particles in one place: 1e12 pairs",
        happens="refused with a sentence, before memory is taken", measure="cases let through", worst=0, bound=0,
    )  # fmt: skip


@pytest.mark.parametrize("positions", [np.zeros((0, 3)), np.zeros((1, 3)), np.ones((9, 3))])
def test_too_few_particles_have_a_sentence(positions):
    with pytest.raises(BackendError, match="distinct particles"):
        derive_parameters(positions)


# -- time and force ----------------------------------------------------------------------------------------------------


def test_any_length_of_a_step(table):
    worst = 0.0
    for dt in 10.0 ** np.arange(-9, 4):
        for speed in (0.0, 1.0, 1e6):
            state = cloud(300, speed=speed, squeeze=0.8)
            parameters = replace(derive_parameters(cloud(300).positions, drag=0.5), buoyancy=(0.0, 0.0, 1.0))
            after, report = step(state, parameters, dt)
            assert is_finite(after)
            moved = np.linalg.norm(after.positions - state.positions, axis=1).max()
            worst = max(worst, moved / most_allowed(report, parameters))
    table.row(
        "length of a step", tried="1e-9 to 1e3 s, at 0 to 1e6 m/s",
        happens="split into substeps; what is still too fast is slowed, and said so",
        measure="way in a step / what a step allows", worst=worst, bound=1,
    )  # fmt: skip


def test_any_buoyancy(table):
    worst = 0.0
    for strength in (0.0, 1e-9, 1.0, 1e2, 1e4, 1e8):
        parameters = replace(derive_parameters(cloud(300).positions, drag=0.5), buoyancy=(strength, 0.0, strength))
        state = cloud(300)
        for _ in range(20):
            state, report = step(state, parameters, 1 / 24)
            assert is_finite(state)
        fastest = np.linalg.norm(state.velocities, axis=1).max()
        terminal = strength * np.sqrt(2.0) / 0.5
        limit = report.substeps * solver_parts.MAX_TRAVEL * parameters.smoothing_length * 24
        worst = max(worst, fastest / max(min(1.05 * terminal, 1.001 * limit), 1e-300))
    table.row(
        "buoyancy", tried="0 to 1e8 m/s^2", happens="no faster than force over drag, nor than a step allows",
        measure="fastest particle / that speed", worst=worst, bound=1,
    )  # fmt: skip


def test_any_density(table):
    """Up to a million times too dense, and as thin: energy never grows, and a step moves no further than it may."""
    worst = worst_way = 0.0
    for ratio in 10.0 ** np.arange(-6, 7, 2):
        state = cloud(400, speed=0.3)
        parameters = replace(derive_parameters(state.positions), viscosity=1.0)
        # The same particles in a ratio times smaller volume.
        factor = ratio ** (-1 / 3)
        state = replace(state, positions=factor * state.positions)
        for _ in range(10):
            after, report = step(state, parameters, 1 / 24)
            assert is_finite(after)
            worst = max(worst, energy(after) / max(energy(state), 1e-300) - 1)
            moved = np.linalg.norm(after.positions - state.positions, axis=1).max()
            worst_way = max(worst_way, moved / most_allowed(report, parameters))
            state = after
    table.row(
        "density over rest density", tried="1e-6 to 1e6", happens="parts where too dense, does nothing where thin",
        measure="growth of energy in a step without forces", worst=worst, bound=1e-12,
    )  # fmt: skip
    table.row(
        "way of a particle, the same", tried="1e-6 to 1e6", happens="limited", measure="way in a step / what a step allows",
        worst=worst_way, bound=1,
    )  # fmt: skip


@pytest.mark.parametrize("dt", [1e-59, 1e60])
@pytest.mark.parametrize("length", [1e-18, 1e18])
def test_the_largest_numbers_allowed(dt, length):
    state = cloud(30, squeeze=length)
    state = replace(state, velocities=np.sign(state.positions - 0.5 * length) * 1e60)
    parameters = FluidParameters(
        smoothing_length=length, rest_density=5.0 / length**3, buoyancy=(1e60, -1e60, 1e60), wind=(1e60, 0.0, 0.0), drag=1e60,
        surface_drag=1e60, viscosity=1e60, vorticity_confinement=1e60, tensile_strength=1e3,
    )  # fmt: skip
    after, report = step(state, parameters, dt)
    assert is_finite(after)
    assert np.abs(after.positions - state.positions).max() <= 3.0 * report.substeps * length


@same_draws
@given(
    exponents=st.tuples(*[st.floats(-9, 3), st.floats(-6, 30), st.floats(-4, 4), st.floats(-4, 4), st.floats(-6, 6)]),
    seed=st.integers(0, 1000),
    pulls=st.booleans(),
)
def test_nothing_becomes_nan(exponents, seed, pulls):
    dt, speed, drag, squeeze, offset = (10.0**exponent for exponent in exponents)
    state = cloud(40, seed=seed, speed=speed, squeeze=squeeze)
    state = replace(state, positions=np.concatenate([state.positions[:20], state.positions[:20]]) + offset)
    parameters = FluidParameters(
        smoothing_length=0.3, rest_density=200.0, buoyancy=(1e4, 0.0, 1e4), drag=drag, viscosity=drag,
        vorticity_confinement=drag, surface_drag=drag, pulls_when_sparse=pulls, tensile_strength=0.1,
    )  # fmt: skip
    for _ in range(3):
        state, report = step(state, parameters, dt)
        assert is_finite(state)
    moved = np.linalg.norm(state.positions - offset, axis=1).max()
    assert moved <= squeeze * 2.0 + 3 * report.substeps * 0.3 * (0.4 + 3 * solver_parts.MAX_SHIFT) + 1e-9 * offset


# -- a thousand steps --------------------------------------------------------------------------------------------------


def test_a_thousand_steps_without_forces(table):
    num = 20_000 if table.is_full else 150
    spacing = num ** (-1 / 3)
    start = cloud(num, speed=0.2 * spacing, squeeze=0.8)
    parameters = derive_parameters(cloud(num).positions)
    state, growth = start, 0.0
    for _ in range(1000):
        after, _ = step(state, parameters, 1 / 24)
        growth = max(growth, energy(after) / energy(state) - 1)
        state = after
    assert is_finite(state)
    np.testing.assert_array_equal(state.masses, start.masses)
    np.testing.assert_array_equal(state.ids, start.ids)
    tried = f"1000 steps of {num:,} particles, squeezed, no forces"
    table.row(
        "energy over a rollout", tried=tried, happens="never grows", measure="largest growth in a step", worst=growth,
        bound=1e-12,
    )  # fmt: skip
    table.row(
        "momentum over a rollout", tried=tried, happens="kept", measure="lost / sum of speeds",
        worst=momentum_error(state, start), bound=1e-9,
    )  # fmt: skip
    drift = abs(float(state.masses.sum()) - float(start.masses.sum()))
    table.row("mass over a rollout", tried=tried, happens="carried, to the last bit", measure="drift", worst=drift, bound=0)


def test_a_thousand_steps_with_forces(table):
    num = 5000 if table.is_full else 120
    state = cloud(num, speed=0.1)
    parameters = replace(
        derive_parameters(state.positions, drag=0.5), buoyancy=(0.0, 0.0, 1.0), viscosity=0.5, vorticity_confinement=0.5
    )
    fastest = 0.0
    for _ in range(1000):
        state, _ = step(state, parameters, 0.02)
        fastest = max(fastest, float(np.linalg.norm(state.velocities, axis=1).max()))
    assert is_finite(state)
    assert np.ptp(state.positions, axis=0).max() < 4.0
    table.row(
        "speed over a rollout", tried=f"1000 steps of {num:,} particles with buoyancy, drag, viscosity, confinement",
        happens="ends at force over drag, 2 m/s", measure="mean speed up, off 2 m/s, relative",
        worst=abs(float(state.velocities[:, 2].mean()) / 2.0 - 1), bound=0.01,
    )  # fmt: skip
    table.row("fastest particle over a rollout", tried="the same", happens="bounded", measure="m/s", worst=fastest, bound=3)


# -- where and how large -----------------------------------------------------------------------------------------------


def test_any_scale_of_the_scene(table):
    """Lengths, velocities and accelerations times a number: results times that number."""
    worst = 0.0
    for scale in 10.0 ** np.arange(-9, 10, 3):
        state = cloud(300, speed=0.3, squeeze=0.8)
        parameters = replace(derive_parameters(cloud(300).positions, drag=0.5), buoyancy=(0.1, 0.0, 1.0), wind=(0.2, 0.0, 0.0))
        larger = replace(state, positions=scale * state.positions, velocities=scale * state.velocities)
        derived = derive_parameters(scale * cloud(300).positions, drag=0.5)
        derived = replace(derived, buoyancy=(0.1 * scale, 0.0, scale), wind=(0.2 * scale, 0.0, 0.0))
        for _ in range(3):
            state, _ = step(state, parameters, 0.04)
            larger, _ = step(larger, derived, 0.04)
        worst = max(worst, float(np.abs(larger.positions / scale - state.positions).max()))
        worst = max(worst, float(np.abs(larger.velocities / scale - state.velocities).max()))
    table.row(
        "scale of the scene", tried="1e-9 to 1e9", happens="results scale with it",
        measure="difference after three steps, m and m/s", worst=worst, bound=1e-8,
    )  # fmt: skip


def test_a_world_far_away(table):
    parameters = replace(derive_parameters(cloud(300).positions, drag=0.5), buoyancy=(0.1, 0.0, 1.0), tensile_strength=0.0)
    here, _ = step(cloud(300, speed=0.3, squeeze=0.8), parameters, 0.04)
    there = cloud(300, speed=0.3, squeeze=0.8)
    there, _ = step(replace(there, positions=there.positions + 1e6), parameters, 0.04)
    worst = float(np.abs(there.positions - 1e6 - here.positions).max())
    table.row(
        "distance of the world's origin", tried="1e6 m", happens="the same step", measure="difference, m", worst=worst,
        bound=1e-8,
    )  # fmt: skip


# -- numbers that are none ---------------------------------------------------------------------------------------------


def test_a_number_that_is_none_is_refused(table):
    parameters = FluidParameters(smoothing_length=1.0, rest_density=1.0)
    let_through, tried = [], 0

    def attempt(name, action):
        nonlocal tried
        tried += 1
        if not refuses(action, name):
            let_through.append(name)

    for bad in (np.nan, np.inf, -np.inf, 1e200):
        for name in ("positions", "velocities", "masses"):
            broken = getattr(cloud(5), name).copy()
            broken[2] = bad
            attempt(name, lambda name=name, broken=broken: step(replace(cloud(5), **{name: broken}), parameters, 0.1))
        attempt("dt", lambda bad=bad: step(cloud(3), parameters, bad))
        for name in (
            "smoothing_length",
            "rest_density",
            "drag",
            "surface_drag",
            "tensile_strength",
            "viscosity",
            "vorticity_confinement",
        ):
            attempt(name, lambda name=name, bad=bad: replace(parameters, **{name: bad}))
        for name in ("buoyancy", "wind"):
            attempt(name, lambda name=name, bad=bad: replace(parameters, **{name: (0.0, bad, 0.0)}))
        if bad == 1e200:
            continue
        v = np.full((4, 3), bad)
        attempt("velocities", lambda v=v: solve_buoyancy(v, np.zeros((4, 3)), np.ones(4), 0.1))
        attempt("weights", lambda bad=bad: solve_buoyancy(np.zeros((4, 3)), np.zeros((4, 3)), np.full(4, bad), 0.1))
        attempt("positions", lambda v=v: divergence(v, np.zeros((4, 3)), 1.0))
    for dt in (0.0, -1.0):
        attempt("dt", lambda dt=dt: step(cloud(3), parameters, dt))
    assert not let_through
    table.row(
        "NaN and infinity", tried=f"in every input, {tried} cases", happens="refused by its name", measure="cases let through",
        worst=len(let_through), bound=0,
    )  # fmt: skip


# -- gradients and digits ----------------------------------------------------------------------------------------------


def test_gradients_are_finite_everywhere(table):
    """Through three steps, at every extreme at once: what a loss on the end says of the start, of buoyancy, wind and drag."""
    largest, tried = 0.0, 0
    for num in (0, 1, 2, 60):
        for squeeze in (0.0, 1e-3, 1.0, 1e3):
            for dt in (1e-9, 1 / 24, 1e3):
                for force in (0.0, 1e4):
                    state = cloud(num, speed=0.3, squeeze=squeeze)
                    parameters = FluidParameters(
                        smoothing_length=0.3,
                        rest_density=60.0,
                        buoyancy=(0.0, 0.0, force),
                        drag=0.5,
                        surface_drag=1.0,
                        viscosity=1.0,
                    )
                    moved = rollout(state, parameters, dt, num_steps=3)
                    found = moved.backward([None] * 3 + [np.ones((num, 3))])
                    arrays = (found.start.positions, found.start.velocities, found.buoyancy, found.wind, np.array(found.drag))
                    assert all(np.isfinite(array).all() for array in arrays)
                    largest = max(largest, float(np.abs(found.start.positions).max(initial=0.0)))
                    tried += 1
    table.row(
        "gradients of three steps",
        tried=f"{tried} cases: 0 to 60 particles, coincident to far apart, dt 1e-9 to 1e3 s, buoyancy 0 and 1e4",
        happens="finite everywhere", measure="largest, by a position", worst=largest, bound=100,
    )  # fmt: skip


def test_single_precision_against_double(table):
    """The compiled step is float64 throughout; its twin in float32 says what that buys."""
    random = np.random.default_rng(0)
    state = state_of(0.75 * random.random((200, 3)), 0.3 * random.normal(size=(200, 3)))
    parameters = derive_parameters(random.random((200, 3)))
    worst = {}
    for dtype in (torch.float64, torch.float32):
        arrays = (torch.as_tensor(state.positions, dtype=dtype), torch.as_tensor(state.velocities, dtype=dtype))
        positions, _ = step_torch(*arrays, torch.as_tensor(state.ids), parameters, 0.01)
        worst[dtype] = float(np.abs(positions.numpy() - step(state, parameters, 0.01)[0].positions).max())
    table.row(
        "compiled step against its twin, float64", tried="200 particles, squeezed", happens="they agree",
        measure="difference, m", worst=worst[torch.float64], bound=1e-9,
    )  # fmt: skip
    table.row(
        "compiled step against its twin, float32", tried="the same", happens="what float32 would cost", measure="difference, m",
        worst=worst[torch.float32], bound=1e-5,
    )  # fmt: skip


def test_a_lone_particle_is_never_pushed(table):
    """Far below and far above the density of one particle."""
    worst = 0.0
    for rest in (1e-6, 1.0, 1e6):
        parameters = FluidParameters(smoothing_length=1.0, rest_density=rest * POLY6, viscosity=1.0, vorticity_confinement=1.0)
        after, _ = step(state_of([[0.0, 0.0, 0.0]]), parameters, 0.1)
        worst = max(worst, float(np.abs(after.positions).max()))
    table.row(
        "rest density about a lone particle", tried="1e-6 to 1e6 of its own", happens="stays", measure="way, m", worst=worst,
        bound=0,
    )  # fmt: skip
