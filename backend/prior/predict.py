"""The network at work: for each frame of a clip a proposal of density and velocity, on the grid before its camera."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO
from zipfile import BadZipFile

import numpy as np
import torch

from backend.contract.errors import BackendError
from backend.geometry.camera import View
from backend.prior.levels import NAME as OF_LEVELS
from backend.prior.levels import LevelNet, read_level_net
from backend.prior.network import PlumeNet, Sight
from backend.prior.parameters import parameters_of
from backend.prior.shares import NAME as OF_SHARES
from backend.prior.shares import ShareNet, read_share_net
from backend.prior.weights import HINT, WEIGHTS
from backend.prior.window import SHAPE, Stand, look, stand_before


@dataclass(frozen=True, slots=True, kw_only=True)
class Proposal:
    """density [X, Y, Z] 1/m and velocity [X, Y, Z, 3] m/s along the world's axes, on the voxels of `stand`."""

    stand: Stand
    density: np.ndarray
    velocity: np.ndarray


class Prior:
    """The trained networks; several threads may ask them at once. levels, shares: the small ones, where the file holds them.
    Raises BackendError where its weights cannot be read."""

    def __init__(self, weights: Path = WEIGHTS) -> None:
        try:
            self.net, self.levels, self.shares = read_net(weights), read_level_net(weights), read_share_net(weights)
        except (OSError, EOFError, BadZipFile, KeyError, ValueError, TypeError, RuntimeError) as error:
            message = f"{weights} does not hold the weights of this version's prior."
            raise BackendError("prior_unreadable", message, hint=HINT) from error

    def propose(
        self,
        depth_at: Callable[[int], np.ndarray],
        view_at: Callable[[int], View],
        centre: np.ndarray,
        source: np.ndarray,
        frame: int,
        *,
        voxel_size: float,
        stride: int,
        num_frames: int,
        seconds_per_frame: float,
    ) -> Proposal:
        """depth_at: frame -> optical depth [h, w] with pixels of about half a voxel; view_at: frame -> its view.

        centre [3] m: of the grid; source [3] m: what the smoke rises from.
        """
        stand = stand_before(view_at(frame), centre, voxel_size=voxel_size, shape=SHAPE)
        window = look(depth_at, view_at, stand, source, frame, stride=stride, num_frames=num_frames)
        with torch.no_grad(), one_thread():
            names = ("images", "matrices", "strides", "conditions", "source")
            sizes = torch.tensor([window.images.shape[:0:-1]], dtype=torch.float32)
            sight = Sight(sizes=sizes, **{name: torch.from_numpy(getattr(window, name))[None] for name in names})
            density, velocity = self.net(sight, SHAPE)[1]
        to_world = stand.from_world[:3, :3]
        speed = voxel_size / (stride * seconds_per_frame)
        return Proposal(
            stand=stand,
            density=density[0].numpy() * (window.scale / voxel_size),
            velocity=(np.moveaxis(velocity[0].numpy(), 0, -1) @ to_world * speed).astype(np.float32),
        )


def read_weights(weights: Path) -> tuple[tuple[int, ...], dict[str, torch.Tensor]]:
    """The large network's widths, and its parameters by name, float32."""
    with np.load(weights, allow_pickle=False) as arrays:
        widths = tuple(int(width) for width in arrays["widths"])
        names = [name for name in arrays.files if name != "widths" and not name.startswith((OF_LEVELS, OF_SHARES))]
        return widths, {name: torch.from_numpy(arrays[name].astype(np.float32)) for name in names}


def read_net(weights: Path) -> PlumeNet:
    """The large network."""
    widths, state = read_weights(weights)
    net = PlumeNet(widths)
    net.load_state_dict(state)
    return net.eval()


@contextmanager
def one_thread() -> Iterator[None]:
    """Sums of the network are split by the number of threads: with one, the bytes are the same everywhere.

    torch keeps part of that number per thread and part of it for all: who asks from several threads at once holds this
    around them all, so that none gives the others their threads back.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def save_weights(net: PlumeNet, file: BinaryIO, levels: LevelNet | None = None, shares: ShareNet | None = None) -> None:
    """As float16, of eight bits for ten in the large network and of nine in the small ones: less than half the size."""
    small = parameters_of(levels, OF_LEVELS) | parameters_of(shares, OF_SHARES)
    rounded = {name: _rounded(values, 2) for name, values in parameters_of(net, "").items()}
    rounded |= {name: _rounded(values, 1) for name, values in small.items()}
    np.savez_compressed(file, widths=np.array(net.widths), **rounded)  # type: ignore[arg-type]


def _rounded(values: np.ndarray, bits: int) -> np.ndarray:
    """float16 to the next whose last `bits` are zero: what is packed is smaller by as many bits of each."""
    step = 1 << bits
    return ((values.view(np.uint16) + np.uint16(step // 2)) & np.uint16(0x10000 - step)).view(np.float16)
