"""The compiled step against its torch twin, with every option, in float64; and the twin in float32 and with gradients."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from backend.physics import colliders
from backend.physics.fluid import FluidParameters, FluidState, derive_parameters, step
from backend.physics.fluid_torch import step_torch

SOLIDS = (
    colliders.HalfSpace(),
    colliders.Sphere(center=(0.5, 0.5, 0.5), radius=0.2, friction=0.3),
    colliders.Box(low=(0.0, 0.0, 0.0), high=(0.2, 0.3, 1.0)),
)
OPTIONS = {
    "plain": {},
    "forces": {"buoyancy": (0.1, 0.2, 1.0), "wind": (1.0, 0.0, 0.0), "drag": 0.7},
    "surface": {"surface_drag": 4.0, "wind": (1.0, 0.0, 0.0)},
    "viscosity": {"viscosity": 3.0},
    "vorticity": {"vorticity_confinement": 2.0},
    "liquid": {"pulls_when_sparse": True},
    "tensile": {"tensile_strength": 0.3, "tensile_exponent": 5},
    "colliders": {"colliders": SOLIDS, "buoyancy": (0.0, 0.0, -9.0)},
    "no solver": {"solver_iterations": 0},
}


@pytest.fixture(autouse=True)
def _one_thread():
    """Tables this small are slower on two threads."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def crowd(num):
    """A squeezed cloud with a pile of coincident particles and a few that are far too fast."""
    random = np.random.default_rng(0)
    positions, velocities = 0.75 * random.random((num, 3)), 0.3 * random.normal(size=(num, 3))
    positions[:6] = positions[:1]
    velocities[6:10] *= 30.0
    return FluidState(
        positions=positions, velocities=velocities, masses=np.ones(num), ids=np.arange(num), born=np.zeros(num, np.int32)
    )


def parameters_of(**options):
    fitting = derive_parameters(np.random.default_rng(1).random((200, 3)))
    return replace(fitting, **options)


def twin(state, parameters, dt, dtype=torch.float64):
    ids = torch.as_tensor(state.ids)
    arrays = (torch.as_tensor(state.positions, dtype=dtype), torch.as_tensor(state.velocities, dtype=dtype))
    return [result.numpy() for result in step_torch(*arrays, ids, parameters, dt)]


@pytest.mark.parametrize("name", OPTIONS)
@pytest.mark.parametrize("num", [0, 1, 2, 200])
def test_same_step(name, num):
    state, parameters = crowd(num), parameters_of(**OPTIONS[name])
    for _ in range(2):
        after, report = step(state, parameters, 0.05)
        positions, velocities = twin(state, parameters, 0.05)
        np.testing.assert_allclose(after.positions, positions, atol=1e-9)
        np.testing.assert_allclose(after.velocities, velocities, atol=1e-9)
        state = after
    if num == 200 and name != "no solver":
        assert report.substeps > 1 and not np.allclose(after.positions, crowd(num).positions, atol=1e-3)


def test_limit_of_a_correction_is_reached():
    """Squeezed hard enough, so that both ways of limiting a correction are taken."""
    state, parameters = crowd(200), parameters_of(solver_iterations=1)
    state = replace(state, positions=0.4 * state.positions, velocities=np.zeros((200, 3)))
    after, _ = step(state, parameters, 0.05)
    moved = np.linalg.norm(after.positions - state.positions, axis=1).max() / parameters.smoothing_length
    assert moved == pytest.approx(0.1, rel=1e-3)
    np.testing.assert_allclose(after.positions, twin(state, parameters, 0.05)[0], atol=1e-9)


def test_single_precision_is_close():
    state, parameters = crowd(200), parameters_of()
    positions, _ = twin(state, parameters, 0.01, torch.float32)
    np.testing.assert_allclose(positions, step(state, parameters, 0.01)[0].positions, atol=1e-4)


def test_gradient_of_the_twin():
    """Where no limit is hit the twin is differentiable: with one particle, v1 = (v0 + dt b) / (1 + k dt)."""
    velocity = torch.tensor([[0.1, 0.0, 0.0]], dtype=torch.float64, requires_grad=True)
    parameters = FluidParameters(smoothing_length=1.0, rest_density=10.0, drag=2.0)
    _, after = step_torch(torch.zeros((1, 3), dtype=torch.float64), velocity, torch.zeros(1, dtype=torch.int64), parameters, 0.5)
    (gradient,) = torch.autograd.grad(after.sum(), velocity)
    np.testing.assert_allclose(gradient.numpy(), 0.5)
