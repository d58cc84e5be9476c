"""A learned distance between pictures, by a network whose weights the user has: LPIPS or ST-LPIPS.

LPIPS: Zhang, Isola, Efros, Shechtman, Wang 2018, eq. 1, version 0.1: features of five layers of AlexNet or VGG-16, each of
unit length over its channels; squared differences, weighted by channel, summed; mean over places, sum over layers.
ST-LPIPS: Ghildyal, Liu 2022: features blurred before they are thinned out, and the first convolution of AlexNet at stride 1.
Its weights are others and so is its scale: it is named apart.

Neither weights nor a library come with this program; torchvision has no build for the CPU-only torch that is pinned here.
What is read are files of tensors (torch.save of a state_dict) under the names of the authors' packages: one with all of
them, or the network's and the layers' weights apart. Which network it is follows from the tensors.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from pickle import UnpicklingError

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from backend.contract.errors import BackendError

_SHIFT = torch.tensor([-0.030, -0.088, -0.188])[:, None, None]  # of pictures in -1..1
_SCALE = torch.tensor([0.458, 0.448, 0.450])[:, None, None]
_LEAST_SIDE = 64  # px; below it the last layer has next to nothing left
_TINY = 1e-10
_CONVOLUTION = re.compile(r"(?:net\.slice\d+|features)\.(\d+)\.weight")
_LAYER = re.compile(r"lin(\d)\.model\.1\.weight")


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """How the convolutions hang together. channels: put out by those of each layer; paddings: of each layer; pool: side, px,
    of the maximum before a layer, where it is in is_pooled."""

    channels: tuple[tuple[int, ...], ...]
    paddings: tuple[int, ...]
    pool: int
    is_pooled: tuple[bool, ...]
    stride: int  # of the first convolution
    is_shift_tolerant: bool = False


ALEX = Plan(
    channels=((64,), (192,), (384,), (256,), (256,)),
    paddings=(2, 2, 1, 1, 1),
    pool=3,
    is_pooled=(False, True, True, False, False),
    stride=4,
)
VGG = Plan(
    channels=((64, 64), (128, 128), (256,) * 3, (512,) * 3, (512,) * 3),
    paddings=(1, 1, 1, 1, 1),
    pool=2,
    is_pooled=(False, True, True, True, True),
    stride=1,
)
ALEX_TOLERANT = Plan(
    channels=ALEX.channels, paddings=ALEX.paddings, pool=3, is_pooled=ALEX.is_pooled, stride=1, is_shift_tolerant=True
)
VGG_TOLERANT = Plan(
    channels=VGG.channels, paddings=VGG.paddings, pool=2, is_pooled=VGG.is_pooled, stride=1, is_shift_tolerant=True
)


class Perceptual:
    """name: "lpips" or "st_lpips". network: "alex" or "vgg"."""

    def __init__(self, plan: Plan, kernels: Sequence[tuple[Tensor, Tensor]], weights: Sequence[Tensor]) -> None:
        self._plan = plan
        self._kernels = list(kernels)  # of every convolution in order: weight [O, I, K, K], bias [O]
        self._weights = list(weights)  # of every layer: [C]
        self._last: tuple[np.ndarray, list[Tensor]] | None = None
        self.name = "st_lpips" if plan.is_shift_tolerant else "lpips"
        self.network = "alex" if plan.channels == ALEX.channels else "vgg"

    def distance(self, shown: np.ndarray, truth: np.ndarray) -> float:
        """Between pictures [H, W, 3], sRGB-coded, 0..1; 0 of equal ones. Raises BackendError where they are too small."""
        if shown.shape != truth.shape:
            raise ValueError(f"pictures {shown.shape} and {truth.shape}")
        if min(shown.shape[:2]) < _LEAST_SIDE:
            raise BackendError(
                "pictures_too_small",
                f"LPIPS needs pictures of at least {_LEAST_SIDE} pixels on each side, not {shown.shape[1]} x {shown.shape[0]}.",
                hint="Leave --lpips out, or score larger pictures.",
            )
        if self._last is None or self._last[0] is not truth:  # one truth has many answers
            self._last = truth, self._features(truth)
        total = 0.0
        for ours, real, weight in zip(self._features(shown), self._last[1], self._weights, strict=True):
            total += float((weight[:, None, None] * (ours - real) ** 2).sum(dim=0).mean())
        return total

    @torch.inference_mode()
    def _features(self, picture: np.ndarray) -> list[Tensor]:
        """Of each layer [C, H', W'], unit length over the channels."""
        values = torch.from_numpy(np.ascontiguousarray(np.moveaxis(picture, 2, 0), np.float32))
        values = ((2.0 * values - 1.0 - _SHIFT) / _SCALE)[None]
        found, kernels, plan = [], iter(self._kernels), self._plan
        for layer, channels in enumerate(plan.channels):
            if plan.is_pooled[layer]:
                values = functional.max_pool2d(values, plan.pool, 1 if plan.is_shift_tolerant else 2)
                values = _thinned(values) if plan.is_shift_tolerant else values
            for index in range(len(channels)):
                stride = plan.stride if layer == index == 0 else 1
                values = functional.conv2d(values, *next(kernels), stride=stride, padding=plan.paddings[layer])
                if plan.is_shift_tolerant and layer == 0 and self.network == "alex":
                    values = _thinned(values)
                values = torch.relu(values)
            found.append(values[0] / (values[0].square().sum(dim=0).sqrt() + _TINY))
        return found


def read_perceptual(paths: Sequence[Path]) -> Perceptual:
    """The network of one file, or of two: the convolutions' and the layers' weights. Raises BackendError."""
    tensors: dict[str, Tensor] = {}
    for path in paths:
        tensors |= _tensors(path)
    names = ", ".join(str(path) for path in paths)
    numbered = {int(match[1]): name for name in tensors if (match := _CONVOLUTION.fullmatch(name))}
    layers = {int(match[1]): name for name in tensors if (match := _LAYER.fullmatch(name))}
    kernels = [
        (tensors[numbered[number]].float(), tensors.get(numbered[number].replace("weight", "bias"), torch.empty(0)).float())
        for number in sorted(numbered)
    ]
    weights = [tensors[layers[number]].float().reshape(-1) for number in sorted(layers)]
    is_tolerant = any(name.endswith(".filt") for name in tensors)
    plans = (ALEX_TOLERANT, VGG_TOLERANT) if is_tolerant else (ALEX, VGG)
    for plan in plans:
        if _fits(plan, kernels, weights):
            return Perceptual(plan, kernels, weights)
    raise BackendError(
        "weights_unknown",
        f"{names} hold {len(kernels)} convolutions and {len(weights)} layers that are no AlexNet or VGG-16 of LPIPS.",
        hint="Give a file with both, or the network's file and the layers' file; docs/evaluate.md says which.",
    )


def _fits(plan: Plan, kernels: Sequence[tuple[Tensor, Tensor]], weights: Sequence[Tensor]) -> bool:
    wanted = [count for layer in plan.channels for count in layer]
    sizes = [(len(weight), len(bias)) for weight, bias in kernels]
    return sizes == [(count, count) for count in wanted] and [len(w) for w in weights] == [c[-1] for c in plan.channels]


def _tensors(path: Path) -> dict[str, Tensor]:
    """What a file holds under which names; nothing in it is run."""
    try:
        found = torch.load(path, map_location="cpu", weights_only=True)
    except (OSError, RuntimeError, UnpicklingError, EOFError, ValueError, KeyError) as error:
        raise BackendError(
            "weights_unreadable", f"{path} holds no tensors that can be read: {error}.", hint="Give a file of torch.save."
        ) from error
    if not isinstance(found, dict):
        raise BackendError("weights_unreadable", f"{path} is no state_dict.", hint="Give a file of torch.save(state_dict).")
    return {str(name): value for name, value in found.items() if isinstance(value, Tensor)}


def _thinned(values: Tensor) -> Tensor:
    """Every second value of [1, C, H, W] after a blur by (1, 2, 1)/4 along both axes, mirrored beyond the border."""
    line = torch.tensor([0.25, 0.5, 0.25])
    kernel = (line[:, None] * line).expand(values.shape[1], 1, 3, 3)
    padded = functional.pad(values, (2, 2, 2, 2), mode="reflect")
    return functional.conv2d(padded, kernel, stride=2, groups=values.shape[1])
