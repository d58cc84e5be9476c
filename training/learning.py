"""What the trainings have in common: a step, the running mean that ships, and the command line of the small networks."""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn


class KernelMuon(torch.optim.Muon):
    """Muon (Jordan 2024) for kernels of convolutions [O, I, X, Y, Z] in channels_last_3d, each a matrix of O rows: a step turns
    all directions that the gradients have by as much, where Adam's is of a few. Steps are as large as AdamW's of the same rate
    (Liu 2025)."""

    def __init__(self, kernels: Iterable[nn.Parameter], *, lr: float, weight_decay: float) -> None:
        self.kernels = list(kernels)
        matrices = [nn.Parameter(_as_matrix(kernel.detach())) for kernel in self.kernels]
        super().__init__(matrices, lr=lr, weight_decay=weight_decay, adjust_lr_fn="match_rms_adamw")

    def step(self, closure: Any = None) -> Any:
        for matrix, kernel in zip(self.param_groups[0]["params"], self.kernels, strict=True):
            matrix.grad = None
            if kernel.grad is not None:
                matrix.grad = _as_matrix(kernel.grad.contiguous(memory_format=torch.channels_last_3d))
        return super().step(closure)


def _as_matrix(kernel: Tensor) -> Tensor:
    """[O, I, X, Y, Z] -> [O, X Y Z I] in the same memory. Raises RuntimeError where that lies otherwise."""
    return kernel.permute(0, 2, 3, 4, 1).view(len(kernel), -1)


def learn(net: nn.Module, mean: nn.Module, optimisers: Sequence[torch.optim.Optimizer], loss: Tensor, *, share: float) -> None:
    """One step down the loss, and `mean`, which ships, by a share of the way towards the new weights."""
    net.zero_grad(set_to_none=True)
    loss.backward()
    nn.utils.clip_grad_norm_(net.parameters(), 1.0)
    for optimiser in optimisers:
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
