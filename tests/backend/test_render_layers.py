"""The coloured mode: against its torch twin and autograd in float64, finite differences, the other mode, extremes, threads."""

from __future__ import annotations

import numba
import numpy as np
import pytest
import torch

from backend.geometry.camera import View
from backend.render import layers, splat
from backend.render.composite import composite
from backend.render.gaussians import Gaussians
from backend.render.torch_twin import render_layers

VIEW = View(width=50, height=37, fx=60.0, fy=55.0, cx=26.0, cy=17.5, camera_to_world=np.eye(4))


def cloud(count: int = 30, *, seed: int = 0, mass: float = 0.4) -> tuple[Gaussians, np.ndarray]:
    random = np.random.default_rng(seed)
    positions = random.uniform((-1.5, -1.2, 3.0), (1.5, 1.2, 7.0), (count, 3))
    gaussians = Gaussians(
        positions=positions,
        scales=random.uniform(0.08, 0.5, (count, 3)),
        rotations=random.normal(size=(count, 4)),
        optical_masses=random.uniform(0.1, 1.0, count) * mass,
        colors=np.ones((count, 3), np.float32),
    )
    return gaussians, random.uniform(size=(count, 3)).astype(np.float32)


def twin(gaussians: Gaussians, features: np.ndarray, view: View = VIEW) -> tuple[list[torch.Tensor], torch.Tensor, torch.Tensor]:
    arrays = (gaussians.positions, gaussians.scales, gaussians.rotations, gaussians.optical_masses, features)
    leaves = [torch.tensor(np.asarray(array), dtype=torch.float64, requires_grad=True) for array in arrays]
    return leaves, *render_layers(*leaves, view)


def weights(seed: int = 9) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(seed)
    return random.normal(size=(3, VIEW.height, VIEW.width)), random.normal(size=(VIEW.height, VIEW.width))


@pytest.mark.parametrize("mass", [0.02, 0.4, 30.0])
def test_the_picture_is_the_twins(mass: float) -> None:
    gaussians, features = cloud(mass=mass)
    found = layers.forward(gaussians, VIEW, features)
    _, color, opacity = twin(gaussians, features)
    bound = 2e-5 + 5e-6 * mass  # splats end where they are exp(-12.5) of their peak
    assert np.abs(found.color - color.detach().numpy()).max() < bound
    assert np.abs(found.opacity - opacity.detach().numpy()).max() < bound


@pytest.mark.parametrize("mass", [0.02, 0.4, 30.0])
def test_gradients_are_autograds(mass: float) -> None:
    gaussians, features = cloud(mass=mass, seed=1)
    grad_color, grad_opacity = weights()
    leaves, color, opacity = twin(gaussians, features)
    (color * torch.tensor(grad_color)).sum().add((opacity * torch.tensor(grad_opacity)).sum()).backward()
    found = layers.backward(layers.forward(gaussians, VIEW, features), grad_color, grad_opacity)
    for name, leaf in zip(("positions", "scales", "rotations", "optical_masses", "features"), leaves, strict=True):
        assert leaf.grad is not None
        expected, ours = leaf.grad.numpy(), getattr(found, name)
        if name == "rotations":  # ours is tangent to the unit sphere
            unit = np.asarray(gaussians.rotations) / np.linalg.norm(gaussians.rotations, axis=1, keepdims=True)
            expected = expected - (expected * unit).sum(axis=1, keepdims=True) * unit
        assert np.abs(ours - expected).max() < 2e-3 * np.abs(expected).max(), name


def test_gradients_are_finite_differences() -> None:
    """Of the numba kernels themselves: moving the camera, and each optical mass."""
    gaussians, features = cloud(8, seed=2)
    grad_color, grad_opacity = weights()

    def loss(changed: Gaussians, view: View = VIEW) -> float:
        found = layers.forward(changed, view, features)
        return float(
            (found.color.astype(np.float64) * grad_color).sum() + (found.opacity.astype(np.float64) * grad_opacity).sum()
        )

    found = layers.backward(layers.forward(gaussians, VIEW, features), grad_color, grad_opacity)
    step = 1e-3
    for axis in range(3):
        values = []
        for sign in (1, -1):
            matrix = np.eye(4)
            matrix[axis, 3] = sign * step
            values.append(loss(gaussians, View(width=50, height=37, fx=60.0, fy=55.0, cx=26.0, cy=17.5, camera_to_world=matrix)))
        assert (values[0] - values[1]) / (2 * step) == pytest.approx(found.camera_translation[axis], rel=0.01, abs=0.05)
    for i in range(len(gaussians)):
        values = []
        for sign in (1, -1):
            masses = gaussians.optical_masses.copy()
            masses[i] *= 1 + sign * step
            changed = Gaussians(
                positions=gaussians.positions,
                scales=gaussians.scales,
                rotations=gaussians.rotations,
                optical_masses=masses,
                colors=gaussians.colors,
            )
            values.append(loss(changed))
        slope = (values[0] - values[1]) / (2 * step * gaussians.optical_masses[i])
        assert slope == pytest.approx(found.optical_masses[i], rel=0.01, abs=0.05)


def test_one_colour_is_the_other_mode() -> None:
    gaussians, _ = cloud(mass=1.0, seed=3)
    features = np.tile(np.float32([0.7, 0.4, 0.2]), (len(gaussians), 1))
    found = layers.forward(gaussians, VIEW, features)
    color, opacity = composite(splat.forward(gaussians, VIEW, features=features).image)
    assert np.abs(found.opacity - opacity).max() < 1e-4
    assert np.abs(found.color - color).max() < 1e-4


def test_what_is_near_hides_what_is_far() -> None:
    gaussians = Gaussians(
        positions=np.array([[0.0, 0.0, 6.0], [0.0, 0.0, 4.0]]),
        scales=np.full((2, 3), 0.6),
        rotations=np.tile([1.0, 0.0, 0.0, 0.0], (2, 1)),
        optical_masses=np.array([50.0, 50.0]),
        colors=np.ones((2, 3)),
    )
    red, blue = np.float32([1, 0, 0]), np.float32([0, 0, 1])
    found = layers.forward(gaussians, VIEW, np.stack([red, blue]))
    assert found.color[2, 17, 26] == pytest.approx(1.0, abs=1e-4) and found.color[0, 17, 26] < 1e-4
    swapped = layers.forward(gaussians, VIEW, np.stack([blue, red]))
    assert swapped.color[0, 17, 26] == pytest.approx(1.0, abs=1e-4)


def test_the_order_of_the_particles_does_not_matter() -> None:
    gaussians, features = cloud(seed=4)
    turn = np.random.default_rng(5).permutation(len(gaussians))
    turned = Gaussians(
        **{name: getattr(gaussians, name)[turn] for name in ("positions", "scales", "rotations", "optical_masses", "colors")}
    )
    one, other = layers.forward(gaussians, VIEW, features), layers.forward(turned, VIEW, features[turn])
    assert np.array_equal(one.color, other.color)
    grad = weights()
    a, b = layers.backward(one, *grad), layers.backward(other, *grad)
    assert np.array_equal(a.positions[turn], b.positions) and np.array_equal(a.features[turn], b.features)


@pytest.mark.parametrize("count", [0, 1])
def test_none_and_one(count: int) -> None:
    gaussians, features = cloud(count)
    found = layers.forward(gaussians, VIEW, features)
    assert np.isfinite(found.color).all() and (found.opacity.max() > 0) == (count > 0)
    gradients = layers.backward(found, *weights())
    assert gradients.positions.shape == (count, 3) and np.isfinite(gradients.positions).all()


@pytest.mark.parametrize("mass", [1e-30, 1e-6, 1e6, 1e20])
def test_extremes_stay_finite(mass: float) -> None:
    gaussians, features = cloud(mass=mass)
    found = layers.forward(gaussians, VIEW, features)
    assert np.isfinite(found.color).all() and found.opacity.min() >= 0.0 and found.opacity.max() <= 1.0
    gradients = layers.backward(found, *weights())
    for name in ("positions", "scales", "rotations", "optical_masses", "features", "camera_translation", "camera_rotation"):
        assert np.isfinite(getattr(gradients, name)).all(), name


def test_bad_gradients_are_refused() -> None:
    found = layers.forward(*cloud(3)[:1], VIEW, cloud(3)[1])
    color, opacity = weights()
    color[0, 0, 0] = np.nan
    with pytest.raises(ValueError, match="NaN"):
        layers.backward(found, color, opacity)
    with pytest.raises(ValueError, match="grad_opacity"):
        layers.backward(found, weights()[0], opacity[1:])


def test_equal_bytes_for_any_number_of_threads() -> None:
    gaussians, features = cloud(300, seed=6)
    kept, answers = numba.get_num_threads(), []
    try:
        for threads in (1, kept):
            numba.set_num_threads(threads)
            found = layers.forward(gaussians, VIEW, features)
            gradients = layers.backward(found, *weights())
            answers.append((found.color.tobytes(), gradients.positions.tobytes(), gradients.features.tobytes()))
    finally:
        numba.set_num_threads(kept)
    assert answers[0] == answers[1]
