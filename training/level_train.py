"""Train the network of levels on its lessons; every tenth plume is held back and scored.

  python -m training.level_train --lessons DIR --beside OTHER.npz --out OUT.npz [--steps 5000] [--start OTHER.npz [--share 0.5]]

OUT.npz: the weights as they ship, the other networks' of OTHER.npz and with them the running mean of this one's. The log, a line
of JSON at each twentieth part, goes to standard output.
"""

from __future__ import annotations

import copy
import json
import math
import sys
import time
from pathlib import Path

import numpy as np
import torch
from numba import njit
from torch import Tensor

from backend.io.atomic import whole_file
from backend.prior.levels import LevelNet, features_of, read_level_net
from backend.prior.predict import read_net, save_weights
from backend.prior.shares import read_share_net
from backend.prior.sheets import HEIGHT, PART, UNIT
from training.learning import learn, small_network_parser
from training.train import Stored, bounded, held_back

_BATCH = 32
_WORST = 1.0  # that one clip's error can count
_OF_PARTS, _OF_WIDTH, _OF_DOUBT = 0.5, 0.3, 0.05
_RESHAPED = 0.6  # of the clips, in each way
_FOOT = 0.08  # units that all levels are moved by
_LEAN, _BEND = 0.05, 0.05  # of height, that levels are moved by; the second at the top of a window
_WIDER = 0.12  # of the logarithm of the width
_SCORED = 4  # every such clip of those held back
_FORGOTTEN = 1e-3  # of the running mean of the weights, at each step


class Clips(Stored):
    """A batch as float32, shares as they were."""

    def batch(self, indices: Tensor) -> dict[str, Tensor]:
        found = {name: array[indices].float() for name, array in self.arrays.items()}
        for name in ("profile", "mass"):
            found[name] = (found[name] / 255).square()
        return found


def mirrored(part: dict[str, Tensor]) -> dict[str, Tensor]:
    """What would be seen if left and right were exchanged: nothing lies elsewhere in depth."""
    found = part | {name: part[name].flip(-1) for name in ("profile", "mass", "middle")}
    found["turns"] = part["turns"] * torch.tensor([1.0, -1.0, 1.0])[:, None]
    found["clues"] = torch.cat([-part["clues"][:, 1:2], -part["clues"][:, :1], part["clues"][:, 2:]], 1)
    return found


def reshaped(part: dict[str, Tensor]) -> dict[str, Tensor]:
    """Smoke moved sideways and in depth, the more the higher and the same all the time, as a steady wind bends it: no divergence
    comes of that; its foot moved a little, as the source is found a little beside; and all of it made wider or narrower."""
    count = len(part["mass"])
    height = 4 * part["clues"][:, HEIGHT, 0].clamp_min(0.0)  # [B, Z] units
    foot, lean, bend = ((torch.rand(count, 1) < _RESHAPED) * much * torch.randn(count, 2) for much in (_FOOT, _LEAN, _BEND))
    size = torch.exp((torch.rand(count) < _RESHAPED) * _WIDER * torch.randn(count))
    moved = foot[:, None] + height[..., None] * (lean[:, None] + bend[:, None] * height[..., None] / 8)  # [B, Z, 2]
    cosine, sine = part["turns"][:, 0, :, None], part["turns"][:, 1, :, None]
    across = cosine * moved[:, None, :, 0] + sine * moved[:, None, :, 1]
    deeper = cosine * moved[:, None, :, 1] - sine * moved[:, None, :, 0]
    by = across * (UNIT / PART)
    mass = _drawn(part["mass"], by, size)
    middle = _drawn(part["mass"] * part["middle"], by, size) / mass.clamp_min(1e-7)
    middle = (size[:, None, None, None] * middle + deeper[..., None]) * (mass > 1e-7)
    width = part["width"] + size.log()[:, None, None]
    return part | {"profile": _drawn(part["profile"], by, size), "mass": mass, "middle": middle, "width": width}


def _drawn(values: Tensor, by: Tensor, size: Tensor) -> Tensor:
    """[B, T, Z, X], `size` [B] times as wide about the middle of X and moved by [B, T, Z] steps along it; linearly."""
    rows = values.reshape(-1, values.shape[-1]).numpy()
    sizes = size[:, None, None].expand(by.shape).reshape(-1).numpy()
    return torch.from_numpy(_draw_rows(rows, by.reshape(-1).numpy(), sizes, np.empty_like(rows))).reshape(values.shape)


@njit(cache=True)
def _draw_rows(rows, by, sizes, found):
    count = rows.shape[1]
    middle = 0.5 * (count - 1)
    for index in range(len(rows)):
        for x in range(count):
            at = middle + (x - middle - by[index]) / sizes[index]
            low = math.floor(at)
            share = np.float32(at - low)
            value = np.float32(0.0)
            if 0 <= low < count:
                value += (np.float32(1.0) - share) * rows[index, low]
            if 0 <= low + 1 < count:
                value += share * rows[index, low + 1]
            found[index, x] = value / sizes[index]
    return found


def errors(net: LevelNet, part: dict[str, Tensor]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """[B] each: means over the smoke of the squared errors of levels' middles, of those of their parts, of those of the widths'
    logarithms, and of how unlikely the middles are by what the network says of them."""
    features, asked = features_of(part["profile"], part["turns"], part["clues"])
    with torch.autocast("cpu", dtype=torch.bfloat16):
        middle, width, unsure = net(features, asked)
    mass = part["mass"] * asked[..., None]
    level = mass.sum(-1)
    of_part = (middle - part["middle"]).square()
    of_level = ((mass * (middle - part["middle"])).sum(-1) / level.clamp_min(1e-7)).square()
    share = level / level.sum(2, keepdim=True).clamp_min(1e-6)
    share = share / share.sum((1, 2), keepdim=True).clamp_min(1e-6)
    of_parts = (mass * of_part).sum(-1) / level.clamp_min(1e-7)
    unlikely = 0.5 * of_level.detach() * torch.exp(-2 * unsure) + unsure
    return tuple((share * each).sum((1, 2)) for each in (of_level, of_parts, (width - part["width"]).square(), unlikely))  # type: ignore[return-value]


def score(net: LevelNet, clips: Clips) -> dict[str, float]:
    """Of clips held back: how far middles are off, in voxels, root of the mean square of each clip, the mean and the median of
    all; and the logarithm of the widths."""
    net.eval()
    with torch.no_grad():
        found = [errors(net, clips.batch(part)) for part in torch.arange(0, len(clips), _SCORED).split(128)]
    net.train()
    level, parts, width, unlikely = (torch.cat(part) for part in zip(*found, strict=True))
    roots = UNIT * level.sqrt()
    means = {
        "rms": UNIT * level.mean().sqrt(),
        "middle": roots.mean(),
        "median": roots.median(),
        "parts": UNIT * parts.mean().sqrt(),
    }
    means |= {"width": width.sqrt().mean(), "unlikely": unlikely.mean()}
    return {name: round(value.item(), 4) for name, value in means.items()}


def mixed(start: LevelNet, learned: LevelNet, share: float) -> LevelNet:
    """The net whose weights lie between those of two, by so much nearer to `learned`."""
    net = copy.deepcopy(start)
    with torch.no_grad():
        for weight, other in zip(net.parameters(), learned.parameters(), strict=True):
            weight.lerp_(other, share)
    return net


def main(arguments: list[str]) -> int:
    parser = small_network_parser(__doc__, steps=5000, rate=2e-3)
    parser.add_argument("--channels", type=int, default=64)
    parser.add_argument("--start", type=Path, help="weights that are taught on")
    parser.add_argument(
        "--share",
        type=float,
        default=1.0,
        help="of what is learned in what ships, the rest as at the start: few lessons teach them by heart (Wortsman et al. 2022)",
    )
    given = parser.parse_args(arguments)
    paths = sorted(given.lessons.glob("*.npz"))
    held = held_back(paths)
    clips, unseen = Clips([path for path in paths if path not in held]), Clips(held)
    torch.manual_seed(0)
    beside, shares = read_net(given.beside), read_share_net(given.beside)
    net = (read_level_net(given.start) if given.start else None) or LevelNet(given.channels)
    net.train()
    start, mean = copy.deepcopy(net), copy.deepcopy(net)
    optimiser = torch.optim.AdamW(net.parameters(), lr=given.rate, weight_decay=1e-3)
    begin, sums, since = time.monotonic(), torch.zeros(4), 0
    for step in range(given.steps):
        done = step / given.steps
        for group in optimiser.param_groups:
            group["lr"] = given.rate * min(1.0, (step + 1) / 100) * 0.5 * (1 + math.cos(math.pi * done))
        part = reshaped(clips.batch(torch.randint(len(clips), (_BATCH,))))
        if step % 2:
            part = mirrored(part)
        of_level, of_parts, of_width, unlikely = errors(net, part)
        terms = [bounded(each, worst=_WORST) for each in (of_level, of_parts, of_width)]
        loss = (terms[0] + _OF_PARTS * terms[1] + _OF_WIDTH * terms[2]).mean() + _OF_DOUBT * unlikely.mean()
        learn(net, mean, [optimiser], loss, share=max(_FORGOTTEN, 1 / (step + 1)))
        sums, since = sums + torch.stack([of_level, of_parts, of_width, unlikely]).detach().mean(dim=1), since + 1
        if (step + 1) % max(1, given.steps // 20) == 0:
            taught = sums / since
            line = {
                "steps": step + 1,
                "rate": given.rate,
                "taught": [round(UNIT * taught[0].item() ** 0.5, 4), round(taught[3].item(), 4)],
                **score(mixed(start, mean, given.share), unseen),
            }
            print(json.dumps(line | {"seconds": round(time.monotonic() - begin, 1)}), flush=True)
            sums, since = torch.zeros(4), 0
            with whole_file(given.out) as target, open(target, "wb") as file:
                save_weights(beside, file, mixed(start, mean, given.share), shares)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
