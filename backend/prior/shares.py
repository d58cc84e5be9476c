"""How much of what may be smoke is: a small network weighs, voxel by voxel, what is known of a frame's density.

The large network says a density, the one of levels where in depth columns of it lie and how unsure that is, other frames where
smoke lasts, and the frame itself how much there is on each ray. None of them is right everywhere, and how far each is to be
trusted depends on the smoke: that is learned here, where fixed powers of them weigh all smoke alike.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from backend.prior.network import Conv, folded
from backend.prior.parameters import read_parameters

NAME = "shares."  # before the names of its parameters, beside those of the large network
CHANNELS = 32, 16, 32  # of a voxel; of blocks, and of larger ones
NUM_FEATURES = 13
_FAINT = 1e-3  # of the largest density: less is as good as none
_THIN = 1e-2  # of the largest optical depth
_FAR = 4.0  # spreads: further from the middle of a column is as good as that
_MOST = 4.0  # of the logarithm of a weight


@dataclass(frozen=True, slots=True, kw_only=True)
class Known:
    """Of a frame, on the voxels of its record, float32.

    said [X, Y, Z] 1/m: by the large network; moved: the same, with levels where the network of levels has them; lasts: around
    the frame; sharp: what fixed powers make of these; depth: optical depth of the frame where each voxel is seen. In voxels:
    middle [X, Z], where along Y the network of levels has the middle of a column, width [Z], how wide columns are, unsure [Z],
    how unsure it is of their middles; asked [Z]: 1 where that network was, 0 where it was not. astray []: how far the two are
    apart in the whole clip, in voxels.
    """

    said: np.ndarray
    moved: np.ndarray
    lasts: np.ndarray
    sharp: np.ndarray
    depth: np.ndarray
    middle: np.ndarray
    width: np.ndarray
    unsure: np.ndarray
    asked: np.ndarray
    astray: np.ndarray


NAMES = tuple(field.name for field in fields(Known))


def features_of(known: Mapping[str, Tensor]) -> Tensor:
    """The fields of Known, each with a batch in front -> [B, NUM_FEATURES, X, Y, Z]: what the network sees, in no units."""
    densities = [_logarithm(known[name], _FAINT) for name in ("said", "moved", "lasts", "sharp")]
    shape = known["said"].shape
    asked = known["asked"][:, None, None, :].expand(shape)
    along = torch.arange(shape[2], dtype=torch.float32)[:, None]
    spread = (known["width"].square() + known["unsure"].square()).sqrt()[:, None, None, :]
    off = ((along - known["middle"][:, :, None, :]) / spread).clamp(-_FAR, _FAR)
    lengths = [(known[name] / 3).log()[:, None, None, :] for name in ("width", "unsure")]
    column = [off / 2, torch.exp(-0.5 * off.square()), *lengths]
    height = torch.linspace(-1.0, 1.0, shape[3]).expand(shape)
    apart = [(each / 3 + 0.1).log()[:, None, None, :] for each in (_apart(known), known["astray"][:, None])]
    column += [each.expand(shape) for each in apart]
    rows = [*densities, _logarithm(known["depth"], _THIN), *(asked * value for value in column), asked, height]
    return torch.stack(rows, 1)


def _apart(known: Mapping[str, Tensor]) -> Tensor:
    """[B, Z] voxels: how far the middle of a level's smoke, by the large network, is from where the other has it."""
    columns = known["said"].sum(2)  # [B, X, Z]
    mass = columns.sum(1).clamp_min(1e-12)
    along = torch.arange(known["said"].shape[2], dtype=torch.float32)
    own = torch.einsum("bxyz,y->bz", known["said"], along) / mass
    return (own - (columns * known["middle"]).sum(1) / mass).abs()


def _logarithm(values: Tensor, least: float) -> Tensor:
    """Of values [B, ..] in their own largest, from about -1 to 1."""
    largest = values.amax(tuple(range(1, values.ndim)), keepdim=True).clamp_min(1e-12)
    return 1 + 2 * (values / largest + least).log() / -float(np.log(least))


class ShareNet(nn.Module):
    """What features_of says -> logarithms of weights [B, X, Y, Z]: of each voxel by itself, in view of what a small U-Net
    (Ronneberger 2015) says of blocks of 2 x 2 x 2 voxels and what is around them."""

    def __init__(self, channels: tuple[int, int, int] = CHANNELS) -> None:
        super().__init__()
        hidden, near, far = channels
        self.each = Conv(NUM_FEATURES, hidden, 1)
        self.entry = Conv(8 * NUM_FEATURES, near, 1)
        self.down = nn.ModuleList(Conv(a, b, 3, padding=1) for a, b in ((near, near), (near, far), (far, far)))
        self.up = nn.ModuleList(Conv(a, near, 3, padding=1) for a in (2 * near, 2 * far))
        self.around = Conv(near, hidden, 1)
        self.exit = Conv(hidden, 1, 1)
        for last in (self.around, self.exit):
            nn.init.zeros_(last.weight)
            nn.init.zeros_(last.bias)  # type: ignore[arg-type]

    def forward(self, features: Tensor) -> Tensor:
        x = self.entry(folded(features))
        passed = []
        for level, conv in enumerate(self.down):
            x = functional.silu(conv(functional.avg_pool3d(x, 2, ceil_mode=True, count_include_pad=False) if level else x))
            passed.append(x)
        for level in range(len(self.up) - 1, -1, -1):
            x = functional.interpolate(x, size=passed[level].shape[2:], mode="nearest")
            x = functional.silu(self.up[level](torch.cat([passed[level], x], dim=1)))
        around = functional.interpolate(self.around(x), size=features.shape[2:], mode="nearest")
        out = self.exit(functional.silu(self.each(features) + around))[:, 0].float()
        return _MOST * torch.tanh(out / _MOST)


def weights_of(net: ShareNet, known: Mapping[str, Tensor]) -> Tensor:
    """[B, X, Y, Z]: what `sharp` is to be multiplied by."""
    return net(features_of(known)).exp()


@torch.no_grad()
def ask(net: ShareNet, known: Known) -> np.ndarray:
    """[X, Y, Z] 1/m: `sharp`, weighed."""
    batch = {name: torch.from_numpy(getattr(known, name)[None].astype(np.float32)) for name in NAMES}
    return known.sharp * weights_of(net, batch)[0].numpy()


def read_share_net(weights: Path) -> ShareNet | None:
    """None where the file holds none. Raises what numpy and torch raise where it holds something else."""
    state = read_parameters(weights, NAME)
    if not state:
        return None
    hidden, near, far = (len(state[name]) for name in ("each.bias", "entry.bias", "down.1.bias"))
    net = ShareNet((hidden, near, far))
    net.load_state_dict(state)
    return net.eval()
