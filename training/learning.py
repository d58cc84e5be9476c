"""What the trainings have in common: a step, the running mean that ships, and the command line of the small networks."""

from __future__ import annotations

import argparse
from pathlib import Path

import torch
from torch import Tensor, nn


def learn(net: nn.Module, mean: nn.Module, optimiser: torch.optim.Optimizer, loss: Tensor, *, share: float) -> None:
    """One step down the loss, and `mean`, which ships, by a share of the way towards the new weights."""
    optimiser.zero_grad(set_to_none=True)
    loss.backward()
    nn.utils.clip_grad_norm_(net.parameters(), 1.0)
    optimiser.step()
    with torch.no_grad():
        for kept, now in zip(mean.parameters(), net.parameters(), strict=True):
            kept.lerp_(now, share)


def small_network_parser(description: str | None, *, steps: int, rate: float) -> argparse.ArgumentParser:
    """Of a network that is taught on lessons of its own and ships beside others."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lessons", type=Path, required=True)
    parser.add_argument("--beside", type=Path, required=True, help="weights whose other networks ship with it")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--steps", type=int, default=steps)
    parser.add_argument("--rate", type=float, default=rate)
    return parser
