"""Train the prior on lessons. Goes on where it was interrupted; every tenth plume is held back and scored.

    .venv/backend/bin/python -m training.train --lessons DIR [DIR ..] --out DIR [--passes 20] [--start OTHER/plumes.npz]

What is scored and ships is the running mean of the weights: after one pass or another the same scene differs more than it gains.
OUT/state.pt: all that is needed to go on; OUT/log.jsonl: a line for each pass, and one for what was started from;
OUT/plumes.npz: the weights as they ship.
"""

from __future__ import annotations

import argparse
import copy
import json
import math
import sys
import time
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from backend.io.atomic import whole_file
from backend.prior.levels import read_level_net
from backend.prior.network import PlumeNet, Sight
from backend.prior.predict import read_weights, save_weights
from backend.prior.shares import read_share_net
from backend.prior.window import NUM_CONDITIONS, OFFSETS, SHAPE
from backend.score.measures import correlation
from training.learning import KernelMuon, learn

_HELD_BACK = 10  # every such plume
_SCORED = 4  # every such lesson of those held back
_SLOW = 0.2  # voxels a stride: motion that need not be known better than that
_WORST = 2.0  # that the error of one lesson can count: a few show hardly any of the smoke that is there
_BATCH = 8
_DECAY = 1e-4  # of the weights, times the rate
_FORGOTTEN = 1e-3  # of the running mean of the weights, at each step


class Stored:
    """All lessons of some files, in memory."""

    def __init__(self, paths: list[Path]) -> None:
        parts = [np.load(path) for path in paths]
        self.arrays = {name: torch.from_numpy(np.concatenate([part[name] for part in parts])) for name in parts[0].files}

    def __len__(self) -> int:
        return len(next(iter(self.arrays.values())))


class Lessons(Stored):
    """A batch as float32."""

    def batch(self, indices: Tensor, mirrored: bool) -> tuple[Sight, Tensor, Tensor]:
        """What is seen, density and velocity; mirrored: left and right exchanged."""
        part = {name: array[indices].float() for name, array in self.arrays.items()}
        density, velocity = part.pop("density"), part.pop("velocity")
        if mirrored:
            sign = torch.tensor([-1.0, 1.0, 1.0])
            density, velocity = density.flip(1), velocity.flip(2) * sign[:, None, None, None]
            last = SHAPE[0] - 1
            matrices, count = part["matrices"], len(OFFSETS)
            offset = matrices[..., 3:] + last * matrices[..., :1]
            part["matrices"] = torch.cat([-matrices[..., :1], matrices[..., 1:3], offset], dim=-1)
            part["source"] = part["source"] * sign + torch.tensor([float(last), 0.0, 0.0])
            turned = torch.ones(NUM_CONDITIONS)
            turned[count : 2 * count] = -1
            part["conditions"] = part["conditions"] * turned
        return Sight(**part), density, velocity


def held_back(plumes: list[Path]) -> list[Path]:
    """Those of a library, in order, that are not learned from."""
    return plumes[5::_HELD_BACK]


def losses(net: PlumeNet, lesson: tuple[Sight, Tensor, Tensor]) -> tuple[Tensor, list[float]]:
    """What is to become small, and of each net the squared error of density, in units of the truth's own size, and of velocity
    inside smoke, in units of how much the truth varies along the same axis, in the mean over the three: most smoke rises much
    faster than it goes sideways or in depth."""
    sight, density, velocity = lesson
    weight = density / (density + 0.05 * density.amax((1, 2, 3), keepdim=True) + 1e-6)
    weight = (weight / weight.sum((1, 2, 3), keepdim=True).clamp_min(1e-6))[:, None]
    usual = (weight * velocity).sum((2, 3, 4), keepdim=True)
    spread = (weight * (velocity - usual).square()).sum((2, 3, 4)) + _SLOW**2
    total, parts = torch.zeros(()), []
    with torch.autocast("cpu", dtype=torch.bfloat16):
        answers = net(sight, SHAPE)
    for (ours, moves), share in zip(answers, (0.5, 1.0), strict=True):
        of_density = (ours - density).square().sum((1, 2, 3)) / density.square().sum((1, 2, 3)).clamp_min(1e-3)
        of_velocity = (weight * (moves - velocity).square()).sum((2, 3, 4)) / spread
        total = total + share * (bounded(of_density).mean() + 0.5 * bounded(of_velocity).mean())
        parts += [of_density.mean().item(), of_velocity.mean().item()]
    return total, parts


def bounded(errors: Tensor, *, worst: float = _WORST) -> Tensor:
    """What is to become small, of errors of any shape: as they are where small, at most `worst`."""
    return worst * torch.tanh(errors / worst)


def take_over(net: PlumeNet, state: dict[str, Tensor]) -> None:
    """The weights of an earlier net, perhaps of one with fewer inputs: those it did not have have no say at first."""
    for name, weight in net.state_dict().items():
        if name.endswith("entry.weight"):
            missing = weight.shape[1] - state[name].shape[1]
            state[name] = functional.pad(state[name], (0, 0, 0, 0, 0, 0, 0, missing))
    net.load_state_dict(state)


def optimisers_of(net: PlumeNet, *, rate: float) -> tuple[torch.optim.Optimizer, ...]:
    """Of the kernels between layers, and of all else."""
    kernels = {name: each for name, each in net.named_parameters() if each.dim() == 5 and not name.endswith("exit.weight")}
    others = [each for name, each in net.named_parameters() if name not in kernels]
    return (
        KernelMuon(kernels.values(), lr=rate, weight_decay=_DECAY),
        torch.optim.AdamW(others, lr=rate, weight_decay=_DECAY),
    )


def score(net: PlumeNet, lessons: Lessons) -> dict[str, float]:
    """Means over lessons held back: correlation of density, and of velocity inside smoke along the grid's axes."""
    net.eval()
    rows: list[list[float]] = []
    with torch.no_grad():
        for part in torch.arange(0, len(lessons), _SCORED).split(_BATCH):
            sight, densities, velocities = lessons.batch(part, mirrored=False)
            with torch.autocast("cpu", dtype=torch.bfloat16):
                answers = net(sight, SHAPE)
            for index in range(len(densities)):
                density, velocity = densities[index].numpy(), velocities[index].numpy()
                inside = density > 0.01 * density.max()
                row = []
                for ours, moves in answers:
                    row.append(correlation(ours[index].numpy(), density))
                    row += [correlation(moves[index, axis].numpy()[inside], velocity[axis][inside]) for axis in range(3)]
                rows.append(row)
    net.train()
    names = [f"{name}{number}" for number in (1, 2) for name in ("density", "sideways", "depth", "up")]
    return {name: round(float(value), 4) for name, value in zip(names, np.nanmean(rows, axis=0), strict=True)}


def note(folder: Path, line: dict[str, object]) -> None:
    """One more line of the log."""
    print(json.dumps(line), flush=True)
    with open(folder / "log.jsonl", "a", encoding="utf-8") as file:
        file.write(json.dumps(line) + "\n")


def main(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lessons", type=Path, required=True, nargs="+", help="each with lessons of the same plumes")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--passes", type=int, default=20)
    parser.add_argument("--rate", type=float, default=2e-3)
    parser.add_argument("--start", type=Path, help="weights as they ship, which are taught on")
    given = parser.parse_args(arguments)
    given.out.mkdir(parents=True, exist_ok=True)
    folders = [sorted(folder.glob("*.npz")) for folder in given.lessons]
    held = [path for paths in folders for path in held_back(paths)]
    lessons, unseen = Lessons([path for paths in folders for path in paths if path not in held]), Lessons(held)
    torch.manual_seed(0)
    net = PlumeNet().to(memory_format=torch.channels_last_3d)
    if given.start:
        take_over(net, read_weights(given.start)[1])
    mean = copy.deepcopy(net)
    optimisers = optimisers_of(net, rate=given.rate)
    first = 0
    if (given.out / "state.pt").exists():
        state = torch.load(given.out / "state.pt", weights_only=True)
        net.load_state_dict(state["net"])
        mean.load_state_dict(state["mean"])
        for optimiser, kept in zip(optimisers, state["optimisers"], strict=True):
            optimiser.load_state_dict(kept)
        first = state["passes"]
    elif given.start:
        note(given.out, {"passes": 0, **score(mean, unseen)})
    num_steps = len(lessons) // _BATCH
    for number in range(first, given.passes):
        begin, sums = time.monotonic(), np.zeros(4)
        order = torch.randperm(len(lessons), generator=torch.Generator().manual_seed(number))
        for step in range(num_steps):
            done = (number * num_steps + step) / (given.passes * num_steps)
            for group in (group for optimiser in optimisers for group in optimiser.param_groups):
                group["lr"] = given.rate * min(1.0, 50 * done + 0.02) * 0.5 * (1 + math.cos(math.pi * done))
            batch = lessons.batch(order[step * _BATCH : (step + 1) * _BATCH], mirrored=bool((step + number) % 2))
            total, parts = losses(net, batch)
            learn(net, mean, optimisers, total, share=max(_FORGOTTEN, 1 / (number * num_steps + step + 1)))
            sums += parts
        line = {"passes": number + 1, "losses": [round(value, 4) for value in sums / num_steps]}
        note(given.out, line | {"seconds": round(time.monotonic() - begin, 1), **score(mean, unseen)})
        with whole_file(given.out / "state.pt") as part:
            kept = {"net": net.state_dict(), "mean": mean.state_dict()}
            torch.save({**kept, "optimisers": [optimiser.state_dict() for optimiser in optimisers], "passes": number + 1}, part)
        with whole_file(given.out / "plumes.npz") as part, open(part, "wb") as file:
            small = (read_level_net(given.start), read_share_net(given.start)) if given.start else ()
            save_weights(mean, file, *small)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
