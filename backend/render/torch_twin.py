"""The renderer once more, to be read: every splat summed directly at full resolution in torch, gradients by autograd.

Runs on any device and in any floating type; memory is chunk x H x W. The numba kernels (splat.py) are tested against it.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from backend.geometry.camera import View

from .projection import DILATION, NEAR, TANGENT_LIMIT


def render(
    positions: Tensor,  # [N, 3] m
    scales: Tensor,  # [N, 3] m
    rotations: Tensor,  # [N, 4] quaternions w x y z
    optical_masses: Tensor,  # [N] m^2
    features: Tensor,  # [N, K]
    view: View,
    *,
    near: float = NEAR,
    chunk: int = 64,
) -> Tensor:
    """[1 + K, H, W]: optical depth, then sums of features weighted by it."""
    in_camera, rotation = to_camera(positions, view)
    seen = in_camera[:, 2] > near
    in_camera, scales, rotations = in_camera[seen], scales[seen], rotations[seen]
    masses, features = optical_masses[seen], features[seen]
    centres, m, to_px2 = project(in_camera, scales, rotations, rotation, view, near)
    image = positions.new_zeros(1 + features.shape[1], view.height, view.width)
    for start in range(0, len(masses), chunk):
        part = slice(start, start + chunk)
        depth = (masses[part] * to_px2[part])[:, None, None] * splat_weights(centres[part], m[part], view)  # [C, H, W]
        tinted = torch.einsum("chw,ck->khw", depth, features[part])
        image = image + torch.cat([depth.sum(dim=0)[None], tinted])
    return image


def render_layers(
    positions: Tensor,  # [N, 3] m
    scales: Tensor,  # [N, 3] m
    rotations: Tensor,  # [N, 4] quaternions w x y z
    optical_masses: Tensor,  # [N] m^2
    features: Tensor,  # [N, K]
    view: View,
    *,
    near: float = NEAR,
) -> tuple[Tensor, Tensor]:
    """The coloured mode (layers.py): premultiplied features [K, H, W] and opacity [H, W], composited front to back."""
    in_camera, rotation = to_camera(positions, view)
    seen = torch.nonzero(in_camera[:, 2] > near)[:, 0]
    seen = seen[torch.argsort(in_camera[seen, 2], stable=True)]
    centres, m, to_px2 = project(in_camera[seen], scales[seen], rotations[seen], rotation, view, near)
    light = positions.new_ones(view.height, view.width)
    color = positions.new_zeros(features.shape[1], view.height, view.width)
    for k, i in enumerate(seen):
        depth = optical_masses[i] * to_px2[k] * splat_weights(centres[k : k + 1], m[k : k + 1], view)[0]
        color = color - features[i][:, None, None] * light * torch.expm1(-depth)
        light = light * torch.exp(-depth)
    return color, 1.0 - light


def to_camera(positions: Tensor, view: View) -> tuple[Tensor, Tensor]:
    """Positions [N, 3] m in camera axes, and the rotation [3, 3] world to camera."""
    rotation = torch.as_tensor(view.rotation_world_to_camera.copy(), dtype=torch.float64, device=positions.device)
    camera = torch.as_tensor(view.position.copy(), dtype=torch.float64, device=positions.device)
    # Far from the origin only float64 keeps the difference; everything after it may be shorter.
    return ((positions.double() - camera) @ rotation.T).to(positions.dtype), rotation.to(positions.dtype)


def project(
    p: Tensor,  # [N, 3] m, camera axes
    scales: Tensor,  # [N, 3] m
    rotations: Tensor,  # [N, 4]
    world_to_camera: Tensor,  # [3, 3]
    view: View,
    near: float,
) -> tuple[Tensor, Tensor, Tensor]:
    """Centres [N, 2] px, M [N, 2, 3] px with covariance M M^T (EWA splatting, eq. 24), factor [N] from m^2 to px^2."""
    x, y, z = p.unbind(dim=1)
    slack_x, slack_y = (TANGENT_LIMIT - 1) * view.width / 2 / view.fx, (TANGENT_LIMIT - 1) * view.height / 2 / view.fy
    tx = (x / z).clamp(-view.cx / view.fx - slack_x, (view.width - view.cx) / view.fx + slack_x)
    ty = (y / z).clamp(-view.cy / view.fy - slack_y, (view.height - view.cy) / view.fy + slack_y)
    zero = torch.zeros_like(z)
    jacobian = torch.stack([view.fx / z, zero, -view.fx * tx / z, zero, view.fy / z, -view.fy * ty / z], dim=1).view(-1, 2, 3)
    m = jacobian @ world_to_camera @ quaternion_matrices(rotations) * scales[:, None, :]
    t = ((z - near) / near).clamp(max=1.0)
    to_px2 = view.fx * view.fy * torch.sqrt(1 + tx * tx + ty * ty) / (z * z) * (t * t * (3 - 2 * t))
    return torch.stack([view.fx * x / z + view.cx, view.fy * y / z + view.cy], dim=1), m, to_px2


def splat_weights(centres: Tensor, m: Tensor, view: View) -> Tensor:
    """[C, H, W] 1/px^2: normal distributions with covariance M M^T + DILATION at the pixels' centres."""
    columns = torch.arange(view.width, dtype=m.dtype, device=m.device) + 0.5
    rows = torch.arange(view.height, dtype=m.dtype, device=m.device) + 0.5
    covariance = m @ m.transpose(1, 2)
    trace = covariance[:, 0, 0] + covariance[:, 1, 1]
    # a c - b^2 has no digits left for thin splats; the cross product of M's rows has all of them
    determinant = torch.linalg.cross(m[:, 0], m[:, 1]).square().sum(dim=1) + DILATION * trace + DILATION**2
    variance_y = covariance[:, 1, 1] + DILATION
    dy = rows[None, :, None] - centres[:, 1, None, None]
    offset = columns[None, None, :] - centres[:, 0, None, None] - (covariance[:, 0, 1] / variance_y)[:, None, None] * dy
    exponent = -0.5 * (dy.square() / variance_y[:, None, None] + offset.square() * (variance_y / determinant)[:, None, None])
    return torch.exp(exponent) / (2 * math.pi * torch.sqrt(determinant))[:, None, None]


def quaternion_matrices(quaternions: Tensor) -> Tensor:
    """Rotation matrices [N, 3, 3] of q / |q|, q [N, 4] as w x y z."""
    w, x, y, z = (quaternions / quaternions.norm(dim=1, keepdim=True)).unbind(dim=1)
    entries = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(entries, dim=1).view(-1, 3, 3)
