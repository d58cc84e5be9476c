"""The fluid's gradient: by hand for one particle, against autograd of the twin and finite differences, extremes, bytes."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numba
import numpy as np
import pytest
import torch

from backend.physics import colliders
from backend.physics.fluid import FluidParameters, FluidState, derive_parameters, number_density, step
from backend.physics.fluid_gradient import number_density_gradient, rollout
from backend.physics.fluid_torch import Air, step_torch

DT = 0.05
AIR = {"buoyancy": (0.3, -0.2, 1.0), "wind": (0.8, 0.1, -0.3), "drag": 0.7}
SOLIDS = (
    colliders.HalfSpace(point=(0.0, 0.0, 0.25), normal=(0.2, 0.0, 1.0)),
    colliders.Sphere(center=(0.5, 0.5, 0.5), radius=0.25, friction=0.3),
)
CASES = {
    "plain": {},
    "air": AIR,
    "surface": {**AIR, "surface_drag": 4.0},
    "viscosity": {**AIR, "surface_drag": 2.0, "viscosity": 3.0},
    "liquid": {"pulls_when_sparse": True, **AIR},
    "tensile": {"tensile_strength": 0.3, "tensile_exponent": 5},
    "colliders": {**AIR, "colliders": SOLIDS, "buoyancy": (0.0, 0.0, -9.0)},
    "one substep": {**AIR, "max_substeps": 1},
    "no solver": {**AIR, "solver_iterations": 0},
}


@pytest.fixture(autouse=True)
def _one_torch_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def state_of(positions, velocities, *, first_id=0):
    num = len(positions)
    return FluidState(
        positions=np.array(positions, np.float64).reshape(-1, 3),
        velocities=np.array(velocities, np.float64).reshape(-1, 3),
        masses=np.ones(num),
        ids=first_id + np.arange(num),
        born=np.zeros(num, np.int32),
    )


def cloud(num, *, squeeze=0.75, speed=0.3, seed=0, first_id=0):
    """A squeezed cloud; a few particles are so fast that they need substeps."""
    random = np.random.default_rng(seed)
    velocities = speed * random.normal(size=(num, 3))
    velocities[:3] *= 8.0
    return state_of(squeeze * random.random((num, 3)), velocities, first_id=first_id)


def parameters_of(**options):
    return replace(derive_parameters(np.random.default_rng(1).random((200, 3))), **options)


@dataclass
class Oracle:
    """Autograd of the twin over the same chain, for the loss sum_k <positions_k, a_k> + <velocities_k, b_k>."""

    start: tuple
    births: list
    air: tuple

    @classmethod
    def of(cls, state, parameters, by_position, by_velocity, births):
        def leaves(values):
            return tuple(torch.tensor(v, dtype=torch.float64, requires_grad=True) for v in values)

        start = leaves((state.positions, state.velocities))
        born = [leaves((b.positions, b.velocities)) if b is not None else None for b in births]
        air = leaves((parameters.buoyancy, parameters.wind, parameters.drag))
        x, v, ids, loss = *start, torch.as_tensor(state.ids), torch.zeros((), dtype=torch.float64)
        for number in range(len(by_position)):
            loss = loss + (x * torch.as_tensor(by_position[number])).sum() + (v * torch.as_tensor(by_velocity[number])).sum()
            if number == len(by_position) - 1:
                break
            if number < len(births) and births[number] is not None:
                x, v = torch.cat([x, born[number][0]]), torch.cat([v, born[number][1]])
                ids = torch.cat([ids, torch.as_tensor(births[number].ids)])
            x, v = step_torch(x, v, ids, parameters, DT, air=Air(buoyancy=air[0], wind=air[1], drag=air[2]))
        every = [*start, *air, *(leaf for pair in born if pair is not None for leaf in pair)]
        found = [g.numpy() for g in torch.autograd.grad(loss, every, materialize_grads=True)]
        rest = iter(found[5:])
        return cls(tuple(found[:2]), [None if b is None else (next(rest), next(rest)) for b in births], tuple(found[2:5]))


def random_gradients(states, seed=5):
    random = np.random.default_rng(seed)
    return [random.normal(size=s.positions.shape) for s in states], [0.1 * random.normal(size=s.positions.shape) for s in states]


def assert_close(ours, theirs, tolerance):
    scale = np.abs(theirs).max(initial=0.0) + 1e-12
    np.testing.assert_allclose(ours, theirs, rtol=0.0, atol=tolerance * scale)


def assert_same_as_twin(state, parameters, *, num_steps, births=(), tolerance):
    moved = rollout(state, parameters, DT, num_steps=num_steps, births=births)
    by_position, by_velocity = random_gradients(moved.states)
    ours = moved.backward(by_position, by_velocity)
    theirs = Oracle.of(state, parameters, by_position, by_velocity, list(births))
    assert_close(ours.start.positions, theirs.start[0], tolerance)
    assert_close(ours.start.velocities, theirs.start[1], tolerance)
    for name, value in zip(("buoyancy", "wind", "drag"), theirs.air, strict=True):
        assert_close(getattr(ours, name), value, tolerance)
    for own, other in zip(ours.births, theirs.births, strict=False):
        assert (own is None) == (other is None)
        if own is not None:
            assert_close(own.positions, other[0], tolerance)
            assert_close(own.velocities, other[1], tolerance)
    return moved


def test_one_particle_by_hand():
    """v1 = (v0 + dt (b + k w)) / (1 + k dt), x1 = x0 + dt v1; loss = x1_z: all by hand with dt = 1/2, k = 2."""
    parameters = FluidParameters(
        smoothing_length=10.0, rest_density=1.0, buoyancy=(0.0, 0.0, 3.0), wind=(4.0, 0.0, 1.0), drag=2.0
    )
    moved = rollout(state_of([[1.0, 2.0, 3.0]], [[0.0, 1.0, 0.0]]), parameters, 0.5)
    found = moved.backward([None, np.array([[0.0, 0.0, 1.0]])])
    np.testing.assert_allclose(found.start.positions, [[0.0, 0.0, 1.0]], rtol=1e-15)
    np.testing.assert_allclose(found.start.velocities, [[0.0, 0.0, 0.25]], rtol=1e-15)
    np.testing.assert_allclose(found.buoyancy, [0.0, 0.0, 0.125], rtol=1e-15)
    np.testing.assert_allclose(found.wind, [0.0, 0.0, 0.25], rtol=1e-15)
    # v1_z = (0 + (3 + k) / 2) / (1 + k / 2), its slope at k = 2: (1/2 - v1_z / 2) / 2 with v1_z = 1.25
    np.testing.assert_allclose(found.drag, 0.5 * (0.5 - 0.5 * 1.25) / 2.0, rtol=1e-13)


@pytest.mark.parametrize("name", CASES)
def test_one_step_as_autograd(name):
    tolerance = 1e-6 if name == "colliders" else 1e-9
    moved = assert_same_as_twin(cloud(150), parameters_of(**CASES[name]), num_steps=1, tolerance=tolerance)
    if name not in ("no solver", "one substep"):
        assert moved.reports[0].substeps > 1
        assert any(p.lambdas.any() for p in moved.steps[0].tape[-1].projections)


@pytest.mark.parametrize("name", ["air", "colliders"])
def test_three_steps_with_births_as_autograd(name):
    """The second birth is none; the loss looks at each state."""
    births = (cloud(30, seed=3, first_id=1000), None, cloud(20, seed=4, first_id=2000))
    parameters = parameters_of(**CASES[name])
    assert_same_as_twin(cloud(120), parameters, num_steps=3, births=births, tolerance=1e-5 if name == "colliders" else 1e-8)


def test_limited_corrections_as_autograd():
    """Squeezed so hard that corrections are limited one by one and then all alike."""
    moved = assert_same_as_twin(cloud(150, squeeze=0.5, seed=1), parameters_of(), num_steps=1, tolerance=1e-8)
    first = moved.steps[0].tape[0].projections[0]
    assert (first.factors < 1.0).any() and first.scale < 0.75


def test_energy_share_between_its_bounds_as_autograd():
    """In one of these substeps the share that lets impulses through is neither 0 nor 1."""
    moved = assert_same_as_twin(cloud(150, speed=0.1), parameters_of(), num_steps=2, tolerance=1e-8)
    shares = []
    for taken in moved.steps:
        for tape in taken.tape:
            total = sum(p.impulses for p in tape.projections)
            shares.append(-2.0 * (tape.motion * total).sum() / (total * total).sum())
    assert any(0.0 < share < 1.0 for share in shares)


@pytest.mark.parametrize("name", ["viscosity", "colliders"])
def test_finite_differences(name):
    """Along one random direction through positions, velocities and air at once, over two steps."""
    state, parameters = cloud(80, speed=0.2), parameters_of(**CASES[name])
    random = np.random.default_rng(9)
    along = [random.normal(size=(80, 3)) for _ in range(2)]
    air = {"buoyancy": random.normal(size=3), "wind": random.normal(size=3), "drag": float(random.normal())}

    def moved(share):
        shifted = replace(state, positions=state.positions + share * along[0], velocities=state.velocities + share * along[1])
        changed = {name: np.array(getattr(parameters, name)) + share * value for name, value in air.items()}
        changed = {name: float(v) if name == "drag" else tuple(v) for name, v in changed.items()}
        return rollout(shifted, replace(parameters, **changed), DT, num_steps=2)

    middle = moved(0.0)
    by_position, by_velocity = random_gradients(middle.states)

    def loss(share):
        states = moved(share).states
        return sum(
            (s.positions * a).sum() + (s.velocities * b).sum() for s, a, b in zip(states, by_position, by_velocity, strict=True)
        )

    found = middle.backward(by_position, by_velocity)
    expected = (found.start.positions * along[0]).sum() + (found.start.velocities * along[1]).sum()
    expected += found.buoyancy @ air["buoyancy"] + found.wind @ air["wind"] + found.drag * air["drag"]
    step_size = 1e-6
    measured = (loss(step_size) - loss(-step_size)) / (2.0 * step_size)
    assert measured == pytest.approx(expected, rel=1e-4)


def test_forward_is_the_step():
    """To the last byte, births included."""
    state, parameters, newborn = cloud(200), parameters_of(**AIR), cloud(10, seed=8, first_id=500)
    moved = rollout(state, parameters, DT, num_steps=2, births=(None, newborn))
    first, _ = step(state, parameters, DT)
    assert moved.states[1].positions.tobytes() == first.positions.tobytes()
    assert len(moved.states[2].positions) == 210 and moved.states[2].ids[-1] == 509


def test_moving_all_alike_moves_all_alike():
    """Where nothing is but the particles, a gradient that asks the same of all is asked of the start, no more, no less."""
    moved = rollout(cloud(200), parameters_of(), DT, num_steps=2)
    asked = np.broadcast_to([0.3, -0.5, 1.0], (200, 3))
    found = moved.backward([None, None, asked])
    np.testing.assert_allclose(found.start.positions.sum(axis=0), asked.sum(axis=0), rtol=1e-9)
    np.testing.assert_allclose(found.start.velocities.sum(axis=0), 2.0 * DT * asked.sum(axis=0), rtol=1e-9)


def test_same_bytes_for_any_number_of_threads():
    state, parameters = cloud(3000, squeeze=2.0), parameters_of(**CASES["viscosity"])
    most = numba.config.NUMBA_NUM_THREADS
    if most < 2:
        pytest.skip("one thread only")
    found = []
    for threads in (1, most):
        numba.set_num_threads(threads)
        moved = rollout(state, parameters, DT, num_steps=2)
        by_position, by_velocity = random_gradients(moved.states)
        gradients = moved.backward(by_position, by_velocity)
        found.append(gradients.start.positions.tobytes() + gradients.start.velocities.tobytes() + gradients.buoyancy.tobytes())
    numba.set_num_threads(most)
    assert found[0] == found[1]


@pytest.mark.parametrize("num", [0, 1, 2])
def test_few_particles(num):
    state = state_of(np.zeros((num, 3)) + 0.01 * np.arange(num)[:, None], np.full((num, 3), 0.1))
    moved = assert_same_as_twin(state, parameters_of(**AIR), num_steps=2, tolerance=1e-9)
    assert len(moved.states[-1].positions) == num


@pytest.mark.parametrize("scale", [1e-18, 1.0, 1e18])
def test_coincident_particles_have_finite_gradients(scale):
    """A pile in one place and all at rest, at any scale; loss and its gradient are finite, and a pile is moved as one."""
    positions = scale * cloud(60).positions
    positions[:20] = positions[0]
    state = state_of(positions, np.zeros((60, 3)))
    parameters = derive_parameters(scale * np.random.default_rng(1).random((200, 3)))
    moved = rollout(state, replace(parameters, buoyancy=(0.0, 0.0, scale)), DT, num_steps=2)
    by_position, by_velocity = random_gradients(moved.states)
    found = moved.backward(by_position, by_velocity)
    for values in (found.start.positions, found.start.velocities, found.buoyancy, found.wind, found.drag):
        assert np.isfinite(values).all()
    np.testing.assert_allclose(found.start.positions.sum(axis=0), sum(by_position).sum(axis=0), rtol=1e-5)


def test_scale_free():
    """Ten times larger in space: the same gradient by positions, to rounding."""
    found = []
    for scale in (1.0, 10.0):
        state = state_of(scale * cloud(100).positions, scale * cloud(100).velocities)
        parameters = derive_parameters(scale * np.random.default_rng(1).random((200, 3)))
        moved = rollout(state, parameters, DT, num_steps=1)
        found.append(moved.backward(random_gradients(moved.states)[0]).start.positions)
    np.testing.assert_allclose(found[0], found[1], atol=1e-9)


def test_number_density_by_differences():
    state, length = cloud(60, squeeze=0.5), parameters_of().smoothing_length
    random = np.random.default_rng(7)
    bars, along = random.normal(size=60), random.normal(size=(60, 3))

    def total(share):
        return float(number_density(state.positions + share * along, length) @ bars)

    measured = (total(1e-6) - total(-1e-6)) / 2e-6
    found = number_density_gradient(state.positions, length, bars)
    assert measured == pytest.approx(float((found * along).sum()), rel=1e-6)
    assert number_density_gradient(np.zeros((0, 3)), length, np.zeros(0)).shape == (0, 3)


def test_memory_is_told():
    moved = rollout(cloud(500, squeeze=1.5), parameters_of(), DT, num_steps=1)
    assert 500 * 8 * 10 < moved.num_bytes < 500 * 8 * 2000


def test_wrong_calls_are_refused():
    state, parameters = cloud(10), parameters_of()
    moved = rollout(state, parameters, DT)
    with pytest.raises(ValueError, match="2 states"):
        moved.backward([None])
    with pytest.raises(ValueError, match="finite"):
        moved.backward([None, np.full((10, 3), np.nan)])
    with pytest.raises(ValueError, match="finite"):
        moved.backward([None, np.zeros((9, 3))])
    with pytest.raises(ValueError, match="vorticity"):
        rollout(state, replace(parameters, vorticity_confinement=1.0), DT)
    with pytest.raises(ValueError, match="births"):
        rollout(state, parameters, DT, births=(None, None))
