"""The numba renderer as a function of torch tensors."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from backend.geometry.camera import View

from . import splat
from .gaussians import Gaussians


def render(
    positions: Tensor,  # [N, 3] m
    scales: Tensor,  # [N, 3] m
    rotations: Tensor,  # [N, 4] quaternions w x y z
    optical_masses: Tensor,  # [N] m^2
    features: Tensor,  # [N, K]
    view: View,
    *,
    near: float | None = None,
) -> Tensor:
    """[1 + K, H, W] float32 on the CPU: as torch_twin.render, by the numba kernels. First derivatives only."""
    return _Render.apply(positions, scales, rotations, optical_masses, features, view, near)  # type: ignore[return-value]


class _Render(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        positions: Tensor,
        scales: Tensor,
        rotations: Tensor,
        optical_masses: Tensor,
        features: Tensor,
        view: View,
        near: float | None,
    ) -> Tensor:
        inputs = (positions, scales, rotations, optical_masses, features)
        arrays = [tensor.detach().cpu().numpy() for tensor in inputs]
        gaussians = Gaussians(
            positions=arrays[0],
            scales=arrays[1],
            rotations=arrays[2],
            optical_masses=arrays[3],
            colors=np.zeros((len(arrays[0]), 3), np.float32),
        )
        ctx.splat = splat.forward(gaussians, view, features=arrays[4], near=near)
        ctx.like = [(tensor.dtype, tensor.device) for tensor in inputs]
        return torch.from_numpy(ctx.splat.image)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor | None, ...]:
        found = splat.backward(ctx.splat, np.ascontiguousarray(grad_outputs[0].cpu().numpy()))
        arrays = (found.positions, found.scales, found.rotations, found.optical_masses, found.features)
        tensors = [
            torch.from_numpy(array).to(device=device, dtype=dtype)
            for array, (dtype, device) in zip(arrays, ctx.like, strict=True)
        ]
        return (*tensors, None, None)
