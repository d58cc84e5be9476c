"""Where in depth the smoke of each level lies, told from a whole clip: a small network over height and time.

While the camera goes around, what stands in front of the source wanders across the view the other way than what stands behind it;
but smoke also drifts, meanders and grows, and what plumes usually do there has to be learned. The large network sees all of that,
too, but in three dimensions and through few frames: in depth, of levels, it is the worse one.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from backend.prior.parameters import read_parameters
from backend.prior.sheets import NUM_CLUES, NUM_PARTS, Sheets, parts

NUM_FEATURES = 15 + NUM_CLUES + NUM_PARTS
NAME = "levels."  # before the names of its parameters, beside those of the large network
_LEAST = 0.02  # of the fullest level of a frame: those with less are not asked
_STIFF = 0.02, 0.1  # how strongly a still level is drawn to the source, across and along the view: a sighting counts 1
_DRIFT = 1.0  # how strongly a drift over half a window is held back
_NEAR = 5.0  # moments: of sightings around one, standard deviation


def features_of(profile: Tensor, turns: Tensor, clues: Tensor) -> tuple[Tensor, Tensor]:
    """profile [B, T, Z, X], turns [B, 3, T], clues [B, C, T, Z] -> what the network sees [B, NUM_FEATURES, T, Z], and 1 where a
    level is asked [B, T, Z]."""
    u = torch.from_numpy(parts()).float()
    cosine, sine, time = (part[..., None] for part in turns.unbind(1))
    mass = profile.sum(-1)
    fullest = mass.amax(2, keepdim=True)
    asked = ((mass > _LEAST * fullest) & (fullest > _LEAST)).float()
    safe = mass.clamp_min(1e-6)
    middle = (profile @ u) / safe
    off = u - middle[..., None]
    width = ((profile * off.square()).sum(-1) / safe).clamp_min(1e-3).sqrt()
    skew = ((profile * off**3).sum(-1) / safe / width**3).clamp(-3.0, 3.0)
    moments = torch.arange(profile.shape[1], dtype=torch.float32)
    near = torch.exp(-0.5 * ((moments[:, None] - moments) / _NEAR).square())
    every = torch.ones(1, len(moments))
    still = _path(middle, asked, [cosine, sine], [*_STIFF], every)
    nearby = _path(middle, asked, [cosine, sine], [*_STIFF], near)
    drift = _path(middle, asked, [cosine, sine, time * cosine, time * sine], [*_STIFF, _DRIFT, _DRIFT], every)
    drift = drift[..., :2] + time[..., None] * drift[..., 2:]
    one = torch.ones_like(mass)
    rows = [
        cosine * still[..., 1] - sine * still[..., 0],
        still[..., 1] * one,
        asked * (middle - cosine * still[..., 0] - sine * still[..., 1]),
        asked.mean(1, keepdim=True) * one,
        asked * middle,
        asked * width,
        asked * skew,
        (mass / fullest.clamp_min(1e-6)).sqrt(),
        mass.sqrt(),
        asked,
        cosine * one,
        sine * one,
        time * one,
        cosine * nearby[..., 1] - sine * nearby[..., 0],
        cosine * drift[..., 1] - sine * drift[..., 0],
    ]
    shape = (asked[..., None] * profile / safe[..., None]).sqrt().permute(0, 3, 1, 2)
    return torch.cat([torch.stack(rows, 1), clues, shape], 1), asked


def _path(middle: Tensor, asked: Tensor, columns: list[Tensor], stiff: list[float], near: Tensor) -> Tensor:
    """[B, 1 or T, Z, N]: by least squares over the moments that count; near [1 or T, T]: how much a moment counts for another."""
    design = torch.stack([column[..., 0] for column in columns], -1)  # [B, T, N]
    counted = near[None, :, :, None] * asked[:, None]  # [B, 1 or T, T, Z]
    normal = torch.einsum("bntz,bta,btc->bnzac", counted, design, design) + torch.diag(torch.tensor(stiff))
    found = torch.einsum("bntz,bta,btz->bnza", counted, design, middle)
    return torch.linalg.solve(normal, found[..., None])[..., 0]


class Block(nn.Module):
    """A residual convolution over moments and levels, then what all of them have in common."""

    def __init__(self, channels: int, dilation: int) -> None:
        super().__init__()
        self.norm = nn.GroupNorm(4, channels)
        self.wide = nn.Conv2d(channels, channels, 3, padding=dilation, dilation=dilation)
        self.mix = nn.Conv2d(channels, channels, 1)
        self.all = nn.Sequential(nn.LayerNorm(2 * channels), nn.Linear(2 * channels, channels))

    def forward(self, x: Tensor, asked: Tensor) -> Tensor:
        x = x + self.mix(functional.silu(self.wide(self.norm(x))))
        where_asked = (x * asked).sum((2, 3)) / asked.sum((2, 3)).clamp_min(1.0)
        return x + self.all(torch.cat([x.mean((2, 3)), where_asked], dim=1))[:, :, None, None]


class LevelNet(nn.Module):
    """What features_of says -> where behind the source the middles of the parts of each level are [B, T, Z, X]; and of each level
    the logarithms of a part's width (standard deviation) and of the middle's error [B, T, Z]; lengths in units."""

    def __init__(self, channels: int = 64) -> None:
        super().__init__()
        self.entry = nn.Conv2d(4 * NUM_FEATURES, channels, 3, padding=1)
        self.blocks = nn.ModuleList(Block(channels, dilation) for dilation in (1, 2, 4, 1, 2, 4, 1))
        self.norm = nn.GroupNorm(4, channels)
        self.exit = nn.Conv2d(channels, 4 * (NUM_PARTS + 3), 1)
        nn.init.zeros_(self.exit.weight)

    def forward(self, features: Tensor, asked: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        asked = functional.avg_pool2d(asked[:, None], 2)
        x = self.entry(functional.pixel_unshuffle(features, 2))
        for block in self.blocks:
            x = block(x, asked)
        out = functional.pixel_shuffle(self.exit(functional.silu(self.norm(x))), 2).float()
        middle = (out[:, :1] + out[:, 3:]).permute(0, 2, 3, 1)
        return middle, out[:, 1], out[:, 2].clamp(-4.0, 2.0)


@torch.no_grad()
def ask(net: LevelNet, sheets: Sheets) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Where the middles of the parts of each level are behind the source [T, Z, X], how wide a part is in depth [T, Z], how
    unsure its middle [T, Z], all in units, and which levels were asked [T, Z]: others' are any."""
    features, asked = features_of(*(torch.from_numpy(part)[None] for part in (sheets.profile, sheets.turns, sheets.clues)))
    middle, width, unsure = net(features, asked)
    return middle[0].numpy(), width[0].clamp(-4.0, 4.0).exp().numpy(), unsure[0].exp().numpy(), asked[0].numpy()


def read_level_net(weights: Path) -> LevelNet | None:
    """None where the file holds none. Raises what numpy and torch raise where it holds something else."""
    state = read_parameters(weights, NAME)
    if not state:
        return None
    net = LevelNet(len(state["entry.bias"]))
    net.load_state_dict(state)
    return net.eval()
