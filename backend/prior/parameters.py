"""Parameters of the small networks in the file of weights: beside those of the large one, under names of their own."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from torch import Tensor, from_numpy, nn


def parameters_of(net: nn.Module | None, name: str) -> dict[str, np.ndarray]:
    """By name, `name` before each, as float16; none of no network."""
    state = {} if net is None else net.state_dict()
    return {name + own: tensor.detach().numpy().astype(np.float16) for own, tensor in state.items()}


def read_parameters(weights: Path, name: str) -> dict[str, Tensor]:
    """float32, by their names without `name`; empty where the file holds none. Raises what numpy raises of other files."""
    with np.load(weights, allow_pickle=False) as arrays:
        return {
            own.removeprefix(name): from_numpy(arrays[own].astype(np.float32)) for own in arrays.files if own.startswith(name)
        }
