"""Every gradient of the renderer: against autograd through the float64 twin, and by finite differences."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from backend.geometry.camera import View
from backend.render import autograd, splat, torch_twin
from backend.render.gaussians import Gaussians
from tests.reference.smoke_scenes import cloud, one, plain_view, turned_view

NAMES = ("positions", "scales", "rotations", "optical_masses", "features")


def tensors(gaussians: Gaussians, features: np.ndarray, *, requires_grad: bool = True) -> list[torch.Tensor]:
    arrays = (gaussians.positions, gaussians.scales, gaussians.rotations, gaussians.optical_masses, features)
    return [torch.tensor(array, dtype=torch.float64, requires_grad=requires_grad) for array in arrays]


def smooth_noise(shape: tuple[int, ...], seed: int = 7) -> np.ndarray:
    """A gradient image with both coarse and fine detail."""
    random = np.random.default_rng(seed)
    rows, columns = np.meshgrid(np.arange(shape[1]), np.arange(shape[2]), indexing="ij")
    waves = [np.sin(random.normal() * rows / 9 + random.normal() * columns / 9 + channel) for channel in range(shape[0])]
    return (np.array(waves) + 0.3 * random.normal(size=shape)).astype(np.float32)


@pytest.mark.parametrize("num_features", [0, 1, 3])
def test_all_gradients_are_those_of_the_twin(num_features):
    view = turned_view(150, 90)
    gaussians = cloud(view, 200)
    features = gaussians.colors[:, :num_features].copy()
    drawn = splat.forward(gaussians, view, features=features)
    grad_image = smooth_noise(drawn.image.shape)
    found = splat.backward(drawn, grad_image)
    inputs = tensors(gaussians, features)
    (torch_twin.render(*inputs, view) * torch.tensor(grad_image.astype(np.float64))).sum().backward()
    for name, tensor in zip(NAMES, inputs, strict=True):
        expected = tensor.grad.numpy() if tensor.grad is not None else np.zeros(tensor.shape)
        assert getattr(found, name).shape == expected.shape
        if expected.size:
            tolerance = 3e-4 if name in ("scales", "rotations") else 5e-5  # second moments feel the cut tails most
            assert np.abs(getattr(found, name) - expected).max() < tolerance * np.abs(expected).max(), name


def test_thin_splats_and_the_clamped_jacobian_have_the_twins_gradient():
    view = plain_view(128, 96, 60.0)
    gaussians = Gaussians(
        positions=np.array([[0.1, 0.2, 2.0], [-0.4, 0.1, 3.0], [4.2, 0.3, 2.0], [0.2, -3.2, 2.0], [0.0, 0.01, 0.015]]),
        scales=np.array([[1.0, 1e-3, 1e-4], [1e-3, 2.0, 1e-3], [1.0, 0.8, 0.9], [1.1, 0.9, 1.0], [2e-3, 3e-3, 2e-3]]),
        rotations=np.array([[0.9, 0.1, 0.2, 0.4], [0.7, -0.3, 0.1, 0.2], [1, 0, 0, 0], [1, 0.2, 0, 0], [1.0, 0, 0, 0.3]]),
        optical_masses=np.array([0.1, 0.2, 1.0, 1.0, 1e-5]),
        colors=np.ones((5, 3)),
    )
    drawn = splat.forward(gaussians, view)
    assert (drawn.geometry.levels >= 0).all()
    grad_image = smooth_noise(drawn.image.shape)
    found = splat.backward(drawn, grad_image)
    inputs = tensors(gaussians, np.zeros((5, 0)))
    (torch_twin.render(*inputs, view) * torch.tensor(grad_image.astype(np.float64))).sum().backward()
    for name, tensor in zip(NAMES[:4], inputs, strict=False):
        for i in range(5):
            expected = tensor.grad.numpy()[i]
            error = np.abs(getattr(found, name)[i] - expected).max()
            assert error < 1e-3 * np.abs(expected).max(), f"{name} of {i}: {getattr(found, name)[i]} for {expected}"


def test_the_cameras_gradient_is_the_finite_difference_of_the_twin():
    view = turned_view(100, 70)
    gaussians = cloud(view, 60, smallest=0.02)
    drawn = splat.forward(gaussians, view)
    grad_image = smooth_noise(drawn.image.shape)
    found = splat.backward(drawn, grad_image)
    weight = torch.tensor(grad_image.astype(np.float64))

    def loss(axis: int, amount: float) -> float:
        move, turn = np.zeros(3), np.zeros(3)
        (move if axis < 3 else turn)[axis % 3] = amount
        local = np.eye(4)
        local[:3, :3] += np.array([[0, -turn[2], turn[1]], [turn[2], 0, -turn[0]], [-turn[1], turn[0], 0]])
        local[:3, :3] = np.linalg.qr(local[:3, :3])[0] * np.sign(np.diag(np.linalg.qr(local[:3, :3])[1]))
        local[:3, 3] = move
        moved = View(**{name: getattr(view, name) for name in View.__slots__} | {"camera_to_world": view.camera_to_world @ local})
        inputs = tensors(gaussians, np.zeros((60, 0)), requires_grad=False)
        return float((torch_twin.render(*inputs, moved) * weight).sum())

    expected = np.array([(loss(axis, 1e-5) - loss(axis, -1e-5)) / 2e-5 for axis in range(6)])
    result = np.concatenate([found.camera_translation, found.camera_rotation])
    assert np.abs(result - expected).max() < 2e-4 * np.abs(expected).max()


def test_finite_differences_of_the_kernels_themselves():
    view = plain_view(96, 72, 90.0)
    base = one((0.1, -0.05, 1.5), (0.15, 0.3, 0.2), mass=0.4, rotation=(0.9, 0.2, -0.3, 0.1))
    drawn = splat.forward(base, view, features=np.array([[0.7]]))
    grad_image = smooth_noise(drawn.image.shape)
    found = splat.backward(drawn, grad_image)

    def loss(name: str, index: int, amount: float) -> float:
        array = getattr(base, name).copy()
        array.reshape(-1)[index] += amount
        moved = Gaussians(**{key: getattr(base, key) for key in base.__slots__} | {name: array})
        image = splat.forward(moved, view, features=np.array([[0.7]])).image
        return float(np.sum(image.astype(np.float64) * grad_image))

    for name in NAMES[:4]:
        gradient = getattr(found, name)
        for index in range(gradient.size):
            difference = (loss(name, index, 2e-3) - loss(name, index, -2e-3)) / 4e-3
            assert gradient.reshape(-1)[index] == pytest.approx(difference, abs=4e-3 * np.abs(gradient).max()), (name, index)


def test_adjoint_mass_is_the_transpose_of_drawing():
    view = turned_view(150, 90)
    gaussians = cloud(view, 300)
    drawn = splat.forward(gaussians, view)
    grad = smooth_noise(drawn.image.shape)[0]
    adjoint = splat.adjoint_mass(drawn, grad)
    forward = np.sum(drawn.image[0].astype(np.float64) * grad)
    scale = np.sum(np.abs(drawn.image[0]) * np.abs(grad), dtype=np.float64)
    assert forward == pytest.approx(np.dot(adjoint, gaussians.optical_masses), abs=1e-6 * scale)
    np.testing.assert_allclose(
        adjoint, splat.backward(drawn, grad[None]).optical_masses, rtol=0, atol=1e-6 * np.abs(adjoint).max()
    )
    empty = splat.reweighted(drawn, np.zeros(300))
    np.testing.assert_array_equal(splat.adjoint_mass(empty, grad), adjoint)


@pytest.mark.parametrize("factor", [1e-30, 1e-12, 1.0, 1e12, 1e30])
def test_gradients_scale_with_the_gradient_image(factor):
    view = turned_view(60, 40)
    drawn = splat.forward(cloud(view, 30), view)
    grad_image = smooth_noise(drawn.image.shape)
    plain, scaled = splat.backward(drawn, grad_image), splat.backward(drawn, (grad_image * factor).astype(np.float32))
    for name in ("positions", "scales", "rotations", "optical_masses"):
        expected = getattr(plain, name) * factor
        np.testing.assert_allclose(getattr(scaled, name), expected, rtol=0, atol=1e-5 * np.abs(expected).max())


def test_the_torch_function_hands_over_values_types_and_gradients():
    view = turned_view(80, 60)
    gaussians = cloud(view, 40)
    inputs = tensors(gaussians, gaussians.colors)
    halves = [tensor.detach().float().requires_grad_() for tensor in inputs]
    image = autograd.render(*halves, view)
    expected = torch_twin.render(*inputs, view)
    assert image.dtype == torch.float32
    assert torch.abs(image - expected).max() < 2e-5 * expected[0].max()
    image.square().sum().backward()
    expected.square().sum().backward()
    for half, whole in zip(halves, inputs, strict=True):
        assert half.grad is not None and half.grad.dtype == torch.float32
        assert torch.abs(half.grad - whole.grad).max() < 3e-4 * torch.abs(whole.grad).max()
