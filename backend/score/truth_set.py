"""A benchmark scene with its truth, as `synth ship` packs it: smoke of every view, cameras, volumes."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import av
import h5py
import numpy as np

from backend.contract.cameras import Cameras, read_cameras
from backend.contract.errors import BackendError
from backend.contract.result import CAMERAS_FILE
from backend.contract.truth import FUTURE_VIDEO, INPUT_VIEW, SMOKE_VIDEO, TRUTH_FILE, TRUTH_FOLDER, VOLUMES_FILE, view_folder
from backend.geometry.camera import View, view_at
from backend.geometry.lattice import Lattice
from backend.io.images import decode_srgb


@dataclass(frozen=True, slots=True, kw_only=True)
class Volume:
    """A moment of the true smoke. density [X, Y, Z] 1/m; velocity [X, Y, Z, 3] m/s or None; voxel (i, j, k) has its centre
    at origin + voxel_size (i, j, k), m."""

    density: np.ndarray
    velocity: np.ndarray | None
    voxel_size: float
    origin: np.ndarray

    @property
    def lattice(self) -> Lattice:
        x, y, z = (float(start) for start in self.origin)
        i, j, k = self.density.shape
        return Lattice(origin=(x, y, z), voxel_size=self.voxel_size, shape=(i, j, k))


class Pictures(Protocol):
    """Some pictures of one size, [H, W, 4] float32 each, read when they are asked for or all there."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: int, /) -> Any: ...


class Truth(Protocol):
    """What a reconstruction is scored on. frames: of each view, the video frames that there are pictures of, in order, the
    input's first; num_seen: how many of them a method may see; future_views: those whose forecast is scored."""

    @property
    def name(self) -> str: ...

    @property
    def num_seen(self) -> int: ...

    @property
    def fps(self) -> float: ...

    @property
    def frames(self) -> dict[str, list[int]]: ...

    @property
    def future_views(self) -> Sequence[str]: ...

    def view(self, name: str, frame: int) -> View: ...

    def pictures(self, name: str) -> Pictures:
        """Of each of frames[name] [H, W, 4] float32 smoke on black: linear light premultiplied, and opacity."""
        ...

    def volume_frames(self) -> list[int]: ...

    def volume(self, frame: int) -> Volume: ...


@dataclass(frozen=True, slots=True, kw_only=True)
class TruthSet:
    """A packed scene. frames: of each view, the video frames that there are pictures of."""

    folder: Path
    name: str
    num_frames: int
    num_seen: int
    fps: float
    frames: dict[str, list[int]]
    cameras: dict[str, Cameras]

    @property
    def future_views(self) -> Sequence[str]:
        return (INPUT_VIEW, "nvs")

    def view(self, name: str, frame: int) -> View:
        return view_at(self.cameras[name], 0 if self.cameras[name].is_still else frame)

    def pictures(self, name: str) -> np.ndarray:
        """[F, H, W, 4] float32 smoke on black: linear light premultiplied, and opacity; F as in frames[name]."""
        found = _read_smoke(self.folder / view_folder(name) / SMOKE_VIDEO)
        future = self.folder / TRUTH_FOLDER / FUTURE_VIDEO
        if name == INPUT_VIEW and future.exists():
            found = np.concatenate([found, _read_smoke(future)])
        if len(found) != len(self.frames[name]):
            raise BackendError(
                "truth_broken",
                f"{self.folder} holds {len(found)} pictures of the view {name}, not {len(self.frames[name])}.",
                hint="Make the set again with `synth ship`.",
            )
        return found

    def volume_frames(self, *, with_velocity: bool = False) -> list[int]:
        """The video frames that there is a volume of."""
        with h5py.File(self.folder / TRUTH_FOLDER / VOLUMES_FILE) as file:
            return [int(frame) for frame in file["velocity_frames" if with_velocity else "density_frames"][:]]  # type: ignore[index]

    def volume(self, frame: int) -> Volume:
        """The true smoke at a frame of volume_frames(). Raises KeyError where there is none."""
        with h5py.File(self.folder / TRUTH_FOLDER / VOLUMES_FILE) as file:
            density = _at(file, "density", frame)
            if density is None:
                raise KeyError(frame)
            return Volume(
                density=density,
                velocity=_at(file, "velocity", frame),
                voxel_size=float(file.attrs["voxel_size"]),  # type: ignore[arg-type]
                origin=np.array(file.attrs["origin"], np.float64),
            )


def read_truth_set(folder: Path) -> TruthSet:
    """Raises BackendError where the folder holds no packed scene."""
    path = folder / TRUTH_FOLDER / TRUTH_FILE
    try:
        truth: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        frames = {name: [int(frame) for frame in found] for name, found in truth["views"].items()}
        counts = int(truth["frames"]["count"]), int(truth["frames"]["seen"]), float(truth["frames"]["fps"])
        name = str(truth["scene"])
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise BackendError(
            "truth_missing", f"{folder} holds no benchmark scene: {error}.", hint="Give a folder that `synth ship` made."
        ) from error
    return TruthSet(
        folder=folder,
        name=name,
        num_frames=counts[0],
        num_seen=counts[1],
        fps=counts[2],
        frames=frames,
        cameras={view: read_cameras(folder / view_folder(view) / CAMERAS_FILE) for view in frames},
    )


def _read_smoke(path: Path) -> np.ndarray:
    """[F, H, W, 4] float32 linear of a video of coded, premultiplied light and opacity."""
    try:
        with av.open(str(path)) as container:
            coded = np.stack([frame.to_ndarray(format="bgra") for frame in container.decode(video=0)])
    except (OSError, ValueError) as error:
        raise BackendError(
            "truth_broken", f"{path} cannot be read: {error}.", hint="Make the set again with `synth ship`."
        ) from error
    return np.stack([decode_srgb(np.ascontiguousarray(picture[..., [2, 1, 0, 3]])) for picture in coded])


def _at(file: h5py.File, name: str, frame: int) -> np.ndarray | None:
    places = np.flatnonzero(file[f"{name}_frames"][:] == frame)  # type: ignore[index]
    return np.asarray(file[name][int(places[0])], np.float32) if len(places) else None  # type: ignore[index]
