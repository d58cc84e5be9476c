"""The network: two 3D U-Nets (Ronneberger 2015), each tuned by where the cameras stood (FiLM, Perez 2018).

The first sees, in every voxel, what each image shows there. It guesses velocities; along them the smoke of each voxel is
followed through the window, and the second sees what each image shows where that smoke then was: of smoke that is followed
rightly, all images speak alike, from all angles. What the second learns does not reach the first through the paths: that
doubled the time of a lesson.

Density is the optical depth that the frame itself shows, times a positive share per voxel along the ray: what the image
says of a ray's total is never learned, only how it spreads. The nets work on blocks of 2 x 2 x 2 voxels, whose values are
channels: wide layers on few cells are what processors are good at.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import cast

import torch
from torch import Tensor, nn
from torch.nn import functional

from backend.prior.window import NUM_CONDITIONS, OFFSETS

_NOW = OFFSETS.index(0)
_BESIDE = tuple(OFFSETS.index(offset) for offset in (-4, -1, 0, 1, 4))  # images that the second also sees unfollowed
_USUAL_SHARE = 0.06  # of a ray's optical depth, in each voxel
_LARGEST_STEP = 6.0  # voxels a stride that a path may take


@dataclass(frozen=True, slots=True, kw_only=True)
class Sight:
    """A batch of windows. images [B, O, h, w], matrices [B, O, 3, 4], strides [B, O], conditions [B, N], source [B, 3].

    sizes [B, 2]: width and height of the part of the images that was taken, from the first column and row on.
    """

    images: Tensor
    sizes: Tensor
    matrices: Tensor
    strides: Tensor
    conditions: Tensor
    source: Tensor


class Conv(nn.Conv3d):
    """A convolution that is oneDNN's wherever nothing is learned: for one window of so few cells torch takes a slow one of its
    own (ConvParams::use_mkldnn, aten/src/ATen/native/Convolution.cpp), with which a proposal takes 2.4 times as long."""

    def forward(self, input: Tensor) -> Tensor:
        learns = torch.is_grad_enabled() or torch.is_autocast_enabled("cpu")
        if learns or input.device.type != "cpu" or not torch.backends.mkldnn.is_available():
            return super().forward(input)
        padding = cast(tuple[int, ...], self.padding)
        return torch.mkldnn_convolution(input, self.weight, self.bias, padding, self.stride, self.dilation, self.groups)


class Block(nn.Module):
    """Two convolutions, each normalised over groups of channels."""

    def __init__(self, num_in: int, num_out: int) -> None:
        super().__init__()
        self.first = Conv(num_in, num_out, 3, padding=1)
        self.second = Conv(num_out, num_out, 3, padding=1)
        self.norms = nn.ModuleList(nn.GroupNorm(8, num_out) for _ in range(2))

    def forward(self, x: Tensor) -> Tensor:
        x = functional.silu(self.norms[0](self.first(x)))
        return functional.silu(self.norms[1](self.second(x)))


class UNet(nn.Module):
    """[B, C, X, Y, Z] -> [B, 4, X, Y, Z]; X, Y and Z must be multiples of 2 to the number of widths."""

    def __init__(self, num_in: int, widths: tuple[int, ...]) -> None:
        super().__init__()
        self.entry = Conv(8 * num_in, widths[0], 3, padding=1)
        self.tune = nn.Sequential(nn.Linear(NUM_CONDITIONS, 64), nn.SiLU(), nn.Linear(64, 2 * widths[0]))
        self.down = nn.ModuleList(Block(a, b) for a, b in zip((widths[0], *widths[:-1]), widths, strict=True))
        self.up = nn.ModuleList(Block(a + b, a) for a, b in pairwise(widths))
        self.exit = Conv(widths[0], 8 * 4, 1)
        nn.init.zeros_(self.exit.weight)
        nn.init.zeros_(cast(Tensor, self.exit.bias))

    def forward(self, x: Tensor, conditions: Tensor) -> Tensor:
        gain, shift = self.tune(conditions)[:, :, None, None, None].chunk(2, dim=1)
        blocks = folded(x).contiguous(memory_format=torch.channels_last_3d)
        x = functional.silu(self.entry(blocks) * (1 + gain) + shift)
        passed = []
        for level, block in enumerate(self.down):
            x = block(functional.avg_pool3d(x, 2) if level else x)
            passed.append(x)
        for level in range(len(self.up) - 1, -1, -1):
            x = functional.interpolate(x, scale_factor=2, mode="nearest")
            x = self.up[level](torch.cat([passed[level], x], dim=1))
        return unfolded(self.exit(x)).float()


class PlumeNet(nn.Module):
    """Sight -> of the first net and of the second: density [B, X, Y, Z] in scale/voxel, velocity [B, 3, X, Y, Z] in voxels a
    stride. shape: X, Y and Z, multiples of 8 with three widths."""

    def __init__(self, widths: tuple[int, ...] = (64, 96, 96)) -> None:
        super().__init__()
        self.widths = widths
        self.first = UNet(len(OFFSETS) + 4, widths)
        self.second = UNet(len(OFFSETS) + len(_BESIDE) + 4 + 4, widths)

    def forward(self, sight: Sight, shape: tuple[int, int, int]) -> tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor]]:
        axes = [torch.arange(size, dtype=torch.float32, device=sight.images.device) for size in shape]
        voxels = torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1)  # [X, Y, Z, 3]
        batch = len(sight.images)
        here = voxels.expand(batch, len(OFFSETS), *voxels.shape)
        standing, is_inside = seen_at(sight, here)
        now = standing[:, _NOW]
        places = ((voxels - sight.source[:, None, None, None]) / 10).permute(0, 4, 1, 2, 3)
        places = torch.cat([places, is_inside[:, _NOW, None]], dim=1)
        guess = _density_and_velocity(self.first(torch.cat([standing, places], dim=1), sight.conditions), now)
        with torch.no_grad():
            followed, _ = seen_at(sight, follow(guess[1], voxels, sight.strides))
        beside = [followed, standing[:, _BESIDE], guess[0][:, None], guess[1], places]
        found = self.second(torch.cat(beside, dim=1), sight.conditions)
        density, change = _density_and_velocity(found, now)
        return guess, (density, guess[1] + change)


def seen_at(sight: Sight, voxels: Tensor) -> tuple[Tensor, Tensor]:
    """What the images show where voxel places [B, O, X, Y, Z, 3] are, bilinearly, and 1 where that is inside of them, both
    [B, O, X, Y, Z]. Outside of an image counts what is at its border: smoke that leaves it goes on."""
    batch, count, height, width = sight.images.shape
    shape = voxels.shape[2:5]
    flat = voxels.reshape(batch * count, -1, 3)
    seen = flat @ sight.matrices[..., :3].reshape(-1, 3, 3).transpose(1, 2) + sight.matrices[..., 3].reshape(-1, 1, 3)
    # Depth is in the scene's metres, whatever they are: nearer than a thousandth of a voxel counts as that.
    least = 1e-3 * sight.matrices[..., 2, :3].norm(dim=-1).reshape(-1, 1, 1)
    pixels = seen[..., :2] * torch.maximum(seen[..., 2:], least).reciprocal()
    last = (sight.sizes - 1).repeat_interleave(count, dim=0)[:, None]
    nearest = torch.minimum(pixels.clamp_min(0.0), last)
    is_inside = ((nearest - pixels).abs().amax(-1) < 0.5).float()
    grid = (2 * nearest + 1) / torch.tensor([width, height], dtype=torch.float32, device=nearest.device) - 1
    found = functional.grid_sample(sight.images.reshape(-1, 1, height, width), grid[:, None], align_corners=False)
    return found.reshape(batch, count, *shape), is_inside.reshape(batch, count, *shape)


def follow(velocity: Tensor, voxels: Tensor, strides: Tensor) -> Tensor:
    """Where the smoke of each voxel is at each image, if the velocity [B, 3, X, Y, Z] voxels a stride stands still.

    From image to image by one Euler step, for blocks of 2 x 2 x 2 voxels and linearly between -> [B, O, X, Y, Z, 3] voxels.
    """
    shape = voxels.shape[:3]
    size = torch.tensor(shape, dtype=torch.float32, device=velocity.device)
    step_at = functional.avg_pool3d(velocity.float().clamp(-_LARGEST_STEP, _LARGEST_STEP), 2)
    start = voxels[::2, ::2, ::2].expand(len(velocity), *step_at.shape[2:], 3) + 0.5
    found: list[Tensor] = [torch.zeros_like(start)] * len(OFFSETS)
    for way in (-1, 1):
        at, index = start, _NOW
        while 0 <= index + way < len(OFFSETS):
            grid = ((2 * at + 1) / size - 1).flip(-1)
            speed = functional.grid_sample(step_at, grid, align_corners=False, padding_mode="border")
            span = (strides[:, index + way] - strides[:, index])[:, None, None, None, None]
            index += way
            at = at + span * speed.permute(0, 2, 3, 4, 1)
            found[index] = at - start
    ways = torch.stack(found, dim=1).flatten(0, 1).permute(0, 4, 1, 2, 3).contiguous()
    ways = functional.interpolate(ways, scale_factor=2, mode="trilinear", align_corners=False)
    return voxels + ways.permute(0, 2, 3, 4, 1).reshape(len(velocity), len(OFFSETS), *shape, 3)


def _density_and_velocity(out: Tensor, now: Tensor) -> tuple[Tensor, Tensor]:
    return functional.softplus(out[:, 0]) * (_USUAL_SHARE / math.log(2)) * now, out[:, 1:]


def folded(x: Tensor) -> Tensor:
    """[B, C, X, Y, Z] -> [B, 8 C, X/2, Y/2, Z/2]: the voxels of a block become channels."""
    b, c, nx, ny, nz = x.shape
    x = x.reshape(b, c, nx // 2, 2, ny // 2, 2, nz // 2, 2)
    return x.permute(0, 1, 3, 5, 7, 2, 4, 6).reshape(b, 8 * c, nx // 2, ny // 2, nz // 2)


def unfolded(x: Tensor) -> Tensor:
    """The inverse of folded."""
    b, c, nx, ny, nz = x.shape
    x = x.reshape(b, c // 8, 2, 2, 2, nx, ny, nz)
    return x.permute(0, 1, 5, 2, 6, 3, 7, 4).reshape(b, c // 8, 2 * nx, 2 * ny, 2 * nz)
