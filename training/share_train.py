"""Train the network of shares on its lessons; every tenth plume is held back and scored.

  python -m training.share_train --lessons DIR --beside OTHER.npz --out OUT.npz [--steps 450] [--of-views 0.5]

OUT.npz: the weights as they ship, the other networks' of OTHER.npz and with them the running mean of this one's. The log, a line
of JSON at each tenth part, goes to standard output.
"""

from __future__ import annotations

from backend import kernel_setup  # noqa: F401 before numba loads

# isort: split
import copy
import json
import math
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from backend.field.rays import at_voxels, optical_depth
from backend.fit.sharpen import agreed
from backend.geometry.camera import View
from backend.geometry.lattice import Lattice
from backend.io.atomic import whole_file
from backend.prior.levels import read_level_net
from backend.prior.predict import read_net, save_weights
from backend.prior.shares import NAMES, ShareNet, weights_of
from backend.prior.window import Stand
from backend.score.measures import correlation
from training.judge import LIGHT
from training.learning import learn, small_network_parser
from training.train import bounded, held_back

_BATCH = 4
_OF_VIEWS = 0.5  # how much the logarithm of a picture's squared error counts, beside the squared error in space
_ASIDE = 90.0  # degrees, of one picture; the other from anywhere between
_BETWEEN = 25.0, 75.0
_SLOWER = 0.02  # times the rate: what sees around voxels, which else soon knows its lessons by heart
_WARM = 30  # steps until the rate is reached
_FORGOTTEN = 2e-2  # of the running mean of the weights, at each step
_WORST = 1.5  # that one moment's error in space can count
_SCORED = 3  # every such moment of those held back
_LEAST_ALIKE = 0.78  # correlation of what fixed powers make with the truth: moments that are worse teach to mistrust all smoke


class Moments:
    """Those of some files, in memory, as they were stored; without those whose density is less like the truth than `least`."""

    def __init__(self, paths: list[Path], *, least: float = -1.0) -> None:
        self.rows: list[dict[str, np.ndarray]] = []
        for path in paths:
            with np.load(path) as arrays:
                stacks = {name: arrays[name] for name in arrays.files}
            rows = [{name: stack[index] for name, stack in stacks.items()} for index in range(len(stacks["truth"]))]
            self.rows += [row for row in rows if correlation(row["sharp"], row["truth"]) >= least]

    def __len__(self) -> int:
        return len(self.rows)

    def batch(self, indices: list[int]) -> dict[str, Any]:
        """Fields of Known and the truth with a batch in front, float32; of each its stand, and its picture with the view."""
        rows = [self.rows[index] for index in indices]
        names = (*NAMES, "truth")
        found: dict[str, Any] = {name: torch.from_numpy(np.stack([row[name] for row in rows])).float() for name in names}
        found["pictures"] = [(row["picture"].astype(np.float32), view_of(row["camera"], row["picture"].shape)) for row in rows]
        found["stands"] = [stand_of(row) for row in rows]
        return found


def view_of(camera: np.ndarray, shape: tuple[int, ...]) -> View:
    """What `camera_of` in training/share_lessons.py made, and height and width."""
    fx, fy, cx, cy = map(float, camera[16:])
    return View(width=shape[1], height=shape[0], fx=fx, fy=fy, cx=cx, cy=cy, camera_to_world=camera[:16].reshape(4, 4))


def stand_of(row: dict[str, np.ndarray]) -> Stand:
    """The grid of a moment, in its own axes."""
    size, shape = float(row["voxel_size"]), row["truth"].shape
    origin = tuple(-0.5 * size * (count - 1) for count in shape)
    return Stand(lattice=Lattice(origin=origin, voxel_size=size, shape=shape), from_world=np.eye(4))  # type: ignore[arg-type]


class Agreed(torch.autograd.Function):
    """Densities [B, X, Y, Z] as their pictures show them. Backward as if the rays' sums were exact: what one voxel gains others
    on its ray lose, each as much as it has."""

    @staticmethod
    def forward(ctx: Any, densities: Tensor, stands: list[Stand], pictures: list[tuple[np.ndarray, View]]) -> Tensor:
        found = [
            agreed(density.numpy(), stand, *shown)
            for density, stand, shown in zip(densities.detach(), stands, pictures, strict=True)
        ]
        ctx.kept = stands, pictures
        out = torch.from_numpy(np.stack(found))
        ctx.save_for_backward(densities, out)
        return out

    @staticmethod
    def backward(ctx: Any, *wanted: Tensor) -> tuple[Tensor, None, None]:
        densities, found = ctx.saved_tensors
        means = []
        for each, gradient, stand, (_, view) in zip(found.numpy(), wanted[0].numpy(), *ctx.kept, strict=True):
            sums = [optical_depth(values, stand.lattice, view, step=0.75) for values in (each * gradient, each)]
            means.append(at_voxels(sums[0] / (sums[1] + 1e-4), stand.lattice, view))
        share = found / densities.clamp_min(1e-8)
        return share * (wanted[0] - torch.from_numpy(np.stack(means))), None, None


def weighed(net: ShareNet, part: dict[str, Any]) -> Tensor:
    """[B, X, Y, Z] 1/m: densities as the network makes them, and as the pictures show them."""
    with torch.autocast("cpu", dtype=torch.bfloat16):
        weights = weights_of(net, part)
    return Agreed.apply(part["sharp"] * weights.float() + 1e-8, part["stands"], part["pictures"])  # type: ignore[return-value]


def mirrored(part: dict[str, Any]) -> dict[str, Any]:
    """What would be seen if left and right were exchanged."""
    turned = {name: part[name].flip(1) for name in ("said", "moved", "lasts", "sharp", "depth", "middle", "truth")}
    pictures = []
    for picture, view in part["pictures"]:
        matrix = view.camera_to_world * np.outer([-1.0, 1.0, 1.0, 1.0], [-1.0, 1.0, 1.0, 1.0])
        own = replace(view, cx=view.width - view.cx, camera_to_world=matrix)
        pictures.append((np.ascontiguousarray(picture[:, ::-1]), own))
    return part | turned | {"pictures": pictures}


def picture_errors(density: Tensor, truth: Tensor, sizes: Tensor, degrees: float) -> Tensor:
    """[B]: mean squared errors of pictures from far away, so many degrees to the side; sizes [B] m, of voxels."""
    shown = [_shown(values, sizes, degrees) for values in (density, truth)]
    return (shown[0] - shown[1]).square().mean((1, 2)) + 1e-6


def _shown(density: Tensor, sizes: Tensor, degrees: float) -> Tensor:
    """[B, X', Z] sRGB: evenly lit smoke on black."""
    angle = math.radians(degrees)
    cosine, sine = math.cos(angle), math.sin(angle)
    flat = density.permute(0, 3, 1, 2)  # [B, Z, X, Y]
    way = torch.tensor([[cosine, sine, 0.0], [-sine, cosine, 0.0]]).expand(len(density), 2, 3)
    turned = functional.grid_sample(flat, functional.affine_grid(way, list(flat.shape), align_corners=False), align_corners=False)
    opacity = -torch.expm1(-turned.sum(-1) * sizes[:, None, None])
    light = (LIGHT * opacity).clamp_min(0.0)
    return torch.where(light > 0.0031308, 1.055 * light.clamp_min(0.0031308) ** (1 / 2.4) - 0.055, 12.92 * light)


def errors(net: ShareNet, part: dict[str, Any], degrees: tuple[float, ...]) -> tuple[Tensor, Tensor]:
    """[B] in space, in the truth's own size; [B, V] of pictures."""
    density, truth = weighed(net, part), part["truth"]
    of_space = (density - truth).square().sum((1, 2, 3)) / truth.square().sum((1, 2, 3)).clamp_min(1e-6)
    sizes = torch.tensor([stand.lattice.voxel_size for stand in part["stands"]], dtype=torch.float32)
    return of_space, torch.stack([picture_errors(density, truth, sizes, each) for each in degrees], 1)


@torch.no_grad()
def score(net: ShareNet, moments: Moments) -> dict[str, float]:
    """Of moments held back: correlation of density, PSNR from aside and from half the way, dB, and the error in space; means."""
    net.eval()
    rows = []
    for index in range(0, len(moments), _SCORED):
        part = moments.batch([index])
        density = weighed(net, part)
        flat = torch.stack([density.flatten(), part["truth"].flatten()])
        sizes = torch.tensor([part["stands"][0].lattice.voxel_size], dtype=torch.float32)
        views = [picture_errors(density, part["truth"], sizes, degrees) for degrees in (_ASIDE, -_ASIDE / 2)]
        space = (density - part["truth"]).square().sum() / part["truth"].square().sum()
        rows.append([torch.corrcoef(flat)[0, 1].item(), *(-10 * math.log10(view.item()) for view in views), space.item()])
    net.train()
    names = ("density", "side_db", "between_db", "space")
    return {name: round(value, 4) for name, value in zip(names, np.mean(rows, axis=0).tolist(), strict=True)}


def main(arguments: list[str]) -> int:
    parser = small_network_parser(__doc__, steps=450, rate=1e-2)
    parser.add_argument("--of-views", type=float, default=_OF_VIEWS)
    given = parser.parse_args(arguments)
    paths = sorted(given.lessons.glob("*.npz"))
    plumes = sorted({path.name.split("_")[0] for path in paths})
    held = {path.name for path in held_back([Path(name) for name in plumes])}
    taught, unseen = ([path for path in paths if (path.name.split("_")[0] in held) == is_held] for is_held in (False, True))
    moments, others = Moments(taught, least=_LEAST_ALIKE), Moments(unseen)
    if len(moments) < _BATCH:
        parser.error(f"{given.lessons} holds {len(moments)} moments to learn from; draw lessons of more plumes.")
    torch.manual_seed(0)
    draw = np.random.default_rng(0)
    beside, levels = read_net(given.beside), read_level_net(given.beside)
    net = ShareNet()
    mean = copy.deepcopy(net)
    of_voxels = [*net.each.parameters(), *net.exit.parameters()]
    of_blocks = [weight for weight in net.parameters() if all(weight is not other for other in of_voxels)]
    rates = (given.rate, _SLOWER * given.rate)
    optimiser = torch.optim.AdamW([{"params": of_voxels}, {"params": of_blocks}], lr=given.rate, weight_decay=1e-3)
    begin, sums = time.monotonic(), []
    print(json.dumps({"steps": 0, "moments": len(moments), "plumes": len(plumes) - len(held), **score(net, others)}), flush=True)
    for step in range(given.steps):
        for group, rate in zip(optimiser.param_groups, rates, strict=True):
            group["lr"] = rate * min(1.0, (step + 1) / _WARM) * 0.5 * (1 + math.cos(math.pi * step / given.steps))
        part = moments.batch(draw.choice(len(moments), _BATCH, replace=False).tolist())
        if draw.random() < 0.5:
            part = mirrored(part)
        between = float(draw.choice([-1, 1]) * draw.uniform(*_BETWEEN))
        of_space, of_views = errors(net, part, (_ASIDE, between))
        loss = (bounded(of_space, worst=_WORST) + given.of_views * of_views.log().mean(1)).mean()
        learn(net, mean, [optimiser], loss, share=max(_FORGOTTEN, 1 / (step + 1)))
        sums.append([of_space.mean().item(), -10 / math.log(10) * of_views.log().mean().item()])
        if (step + 1) % max(1, given.steps // 10) == 0:
            space, db = np.mean(sums, axis=0)
            line = {"steps": step + 1, "taught": [round(float(space), 4), round(float(db), 3)], **score(mean, others)}
            print(json.dumps(line | {"seconds": round(time.monotonic() - begin, 1)}), flush=True)
            sums = []
            with whole_file(given.out) as target, open(target, "wb") as file:
                save_weights(beside, file, levels, mean)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
