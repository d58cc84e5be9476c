"""Frames in an HDF5 file, one compressed chunk each, so that a clip is never held in memory.

Stored as uint16: colour channels sRGB-coded (steps no eye sees, also in the dark), a fourth channel linear.
"""

from __future__ import annotations

from collections.abc import Iterator

import h5py
import numpy as np

from backend.contract.errors import BackendError
from backend.io.images import decode_srgb, encode_srgb


class FrameStackWriter:
    """Appends frames to a new dataset `name` of a file or group. The same frames make the same bytes."""

    def __init__(self, group: h5py.Group, name: str, num_frames: int, shape: tuple[int, int, int]) -> None:
        """shape: [h, w, C] of one frame, C 3 or 4."""
        if num_frames < 1 or len(shape) != 3 or shape[2] not in (3, 4) or min(shape) < 1:
            raise ValueError(f"{num_frames} frames of shape {shape} cannot be stored")
        self.shape = shape
        self.num_written = 0
        self._data = group.create_dataset(
            name, (num_frames, *shape), np.uint16, chunks=(1, *shape), compression="lzf", shuffle=True
        )

    def append(self, frame: np.ndarray) -> None:
        """frame [h, w, C] float linear; clipped to 0..1."""
        if frame.shape != self.shape:
            raise ValueError(f"a frame of shape {frame.shape} in a stack of {self.shape}")
        if self.num_written >= len(self._data):
            raise ValueError(f"the stack is full at {len(self._data)} frames")
        self._data[self.num_written] = encode_srgb(frame, np.uint16)
        self.num_written += 1


class FrameStack:
    """Reads frames by number: float32 linear [h, w, C]."""

    def __init__(self, group: h5py.Group, name: str) -> None:
        data = group.get(name)
        if not isinstance(data, h5py.Dataset) or data.ndim != 4 or data.dtype != np.uint16:
            raise BackendError(
                "frames_damaged", f"{group.file.filename} holds no frames named {name}.", hint="Delete it and run the job again."
            )
        self._data = data

    @property
    def shape(self) -> tuple[int, int, int]:
        """[h, w, C] of one frame."""
        height, width, channels = self._data.shape[1:]
        return height, width, channels

    def __len__(self) -> int:
        return self._data.shape[0]

    def __getitem__(self, frame: int) -> np.ndarray:
        if not -len(self) <= frame < len(self):
            raise IndexError(f"frame {frame} of {len(self)}")
        return decode_srgb(self._data[frame % len(self)])

    def __iter__(self) -> Iterator[np.ndarray]:
        return (self[frame] for frame in range(len(self)))
