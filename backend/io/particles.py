"""particles.h5: the durable asset. Every frame's particles, the cameras, the fluid, and where they came from.

Frames lie end to end: the rows offsets[t] to offsets[t + 1] of each array are frame t. Frame 0 is the first fitted
frame; the forecast follows the fitted frames. Layout, units and an example with h5py alone: docs/particles.md.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from backend.contract.cameras import Cameras, parse_cameras
from backend.contract.errors import BackendError
from backend.contract.light import Light, parse_light
from backend.contract.units import PARTICLES_FORMAT_VERSION, PARTICLES_UNITS
from backend.io.atomic import storage_errors, whole_file
from backend.io.hdf5_sink import Hdf5Sink
from backend.io.header_digest import DIGEST, header_digest

FORMAT_NAME = "wildsmoke particles"
Vector = tuple[float, float, float]

_LIGHT = "light_"  # attributes of physics
_CHUNK_ROWS = 8192
_MAX_COMPRESSION = 1100  # deflate reaches 1032:1, so a file cannot hold more bytes than this many times its size
_COLUMNS: dict[str, tuple[str, tuple[int, ...]]] = {  # name -> type on disk, shape of one particle
    "positions": ("<f8", (3,)),
    "velocities": ("<f4", (3,)),
    "scales": ("<f4", ()),
    "optical_masses": ("<f4", ()),
    "colors": ("<f4", (3,)),
    "ids": ("<i8", ()),
}
_ANISOTROPIC = {"scales": ("<f4", (3,)), "rotations": ("<f4", (4,))}
_DAMAGED = (OSError, RuntimeError, KeyError, ValueError, TypeError, AttributeError, OverflowError)


@dataclass(frozen=True, slots=True, kw_only=True)
class ParticleFrame:
    """The visual particles of one frame: Gaussians of extinction. Both scales and rotations, or scales [N] alone."""

    positions: np.ndarray  # [N, 3] float64 m, world
    velocities: np.ndarray  # [N, 3] float32 m/s
    scales: np.ndarray  # [N] float32 m standard deviation; [N, 3] along the particle's own axes where anisotropic
    optical_masses: np.ndarray  # [N] float32 m^2, extinction integrated over space
    colors: np.ndarray  # [N, 3] float32 linear RGB radiance, as filmed
    ids: np.ndarray  # [N] int64, one smoke parcel keeps its id from birth to death
    rotations: np.ndarray | None = None  # [N, 4] float32 unit quaternion w x y z, particle axes -> world

    @property
    def count(self) -> int:
        return len(self.positions)


@dataclass(frozen=True, slots=True, kw_only=True)
class ParticlesInfo:
    """All that holds for the whole clip.

    frame_start: the clip's frame that is frame 0 here. gravity: m/s^2, world. buoyancy: learned, m/s^2;
    buoyancy_uncertainty: its standard deviation, m/s^2. fluid: parameters of the simulation, unit in each name.
    light: the clip's, where its smoke shows one.
    provenance: version, source fingerprint, settings; JSON values, no times and no paths, so that equal runs give
    equal bytes. fingerprint: names the settings and inputs that this file follows from.
    """

    cameras: Cameras
    gravity: Vector
    frame_start: int = 0
    buoyancy: Vector = (0.0, 0.0, 0.0)
    buoyancy_uncertainty: Vector = (0.0, 0.0, 0.0)
    fluid: Mapping[str, float] = field(default_factory=dict)
    light: Light | None = None
    provenance: Mapping[str, Any] = field(default_factory=dict)
    fingerprint: str = ""


class ParticlesWriter:
    """Writes frame by frame and holds none of them. The file appears when `finish` was called, and only then.

    with ParticlesWriter(path) as writer:
        writer.append(frame)  # fitted ones first
        writer.append(frame, is_forecast=True)
        writer.finish(info)
    """

    def __init__(self, path: str | Path) -> None:
        self._path = Path(path)
        self._offsets = [0]
        self._num_forecast = 0
        self._is_anisotropic: bool | None = None
        self._datasets: dict[str, Any] = {}  # kept open: one that is closed packs its last chunk, and unpacks it again
        self._lives = _Lives()
        self._is_finished = False
        self._stack = ExitStack()

    def __enter__(self) -> ParticlesWriter:
        with ExitStack() as stack:
            part = stack.enter_context(whole_file(self._path))
            self._sink = Hdf5Sink(part)
            stack.callback(self._sink.check)
            stack.callback(self._sink.close)
            self._file = stack.enter_context(h5py.File(self._sink, "w", libver=("v110", "v110"), track_order=False))
            self._stack = stack.pop_all()
        return self

    def __exit__(self, kind: Any, value: Any, traceback: Any) -> None:
        if kind is None and not self._is_finished:
            # Leaving through an exception is what makes whole_file drop the part.
            error = ValueError("ParticlesWriter was left without finish()")
            self._stack.__exit__(ValueError, error, None)
            raise error
        self._stack.__exit__(kind, value, traceback)

    def append(self, frame: ParticleFrame, *, is_forecast: bool = False) -> None:
        """Add the next frame. Raises ValueError if a shape or a value is not what ParticleFrame says."""
        index = len(self._offsets) - 1
        if self._num_forecast and not is_forecast:
            raise ValueError(f"frame {index} is fitted, but follows a forecast")
        columns = _columns(frame.rotations is not None)
        _check_frame(frame, columns, name=f"frame {index}")
        if self._is_anisotropic is None:
            self._is_anisotropic = frame.rotations is not None
            self._create(columns)
        elif self._is_anisotropic != (frame.rotations is not None):
            raise ValueError(f"frame {index}: either all frames have rotations or none")
        self._lives.see(frame.ids, index)
        start, stop = self._offsets[-1], self._offsets[-1] + frame.count
        for name, dataset in self._datasets.items():
            dataset.resize(stop, axis=0)
            dataset[start:stop] = getattr(frame, name)
        self._check_storage()
        self._offsets.append(stop)
        self._num_forecast += is_forecast

    def finish(self, info: ParticlesInfo) -> None:
        """Write what holds for the whole clip; leaving the `with` then puts the file in place."""
        if self._is_anisotropic is None:
            self._create(_columns(False))
        file = self._file
        file.attrs["format"] = np.bytes_(FORMAT_NAME.encode())
        file.attrs["format_version"] = PARTICLES_FORMAT_VERSION
        file.attrs["conventions"] = np.bytes_(b"SI; world right-handed, z up; camera x right, y down, z forward")
        file.attrs["num_frames"] = len(self._offsets) - 1 - self._num_forecast
        file.attrs["num_forecast"] = self._num_forecast
        file.attrs["frame_start"] = info.frame_start
        file.attrs["fps"] = info.cameras.fps
        file.attrs["fingerprint"] = info.fingerprint
        _write_array(file.create_group("frames"), "offsets", np.array(self._offsets, "<i8"))
        self._lives.write(file.create_group("identities"), len(self._offsets) - 1)
        _write_cameras(file.create_group("cameras"), info.cameras)
        _write_physics(file.create_group("physics"), info)
        _write_text(file, "provenance", json.dumps(dict(info.provenance), sort_keys=True, allow_nan=False))
        file.attrs[DIGEST] = header_digest(file)
        self._check_storage()
        self._is_finished = True

    def _check_storage(self) -> None:
        with storage_errors(self._path):
            self._sink.check()

    def _create(self, columns: dict[str, tuple[str, tuple[int, ...]]]) -> None:
        group = self._file.create_group("particles")
        for name, (dtype, shape) in columns.items():
            dataset = group.create_dataset(
                name,
                shape=(0, *shape),
                maxshape=(None, *shape),
                chunks=(_CHUNK_ROWS, *shape),
                dtype=dtype,
                shuffle=True,
                compression="gzip",
                compression_opts=2,
                fletcher32=True,
                track_times=False,
            )
            dataset.attrs["unit"] = np.bytes_(PARTICLES_UNITS.get(name, "1").encode())
            self._datasets[name] = dataset


class Particles:
    """A particles.h5, open for reading. Frames are read when asked for."""

    def __init__(self, path: str | Path) -> None:
        self._path = Path(path)
        try:
            self._file = h5py.File(self._path, "r")
        except FileNotFoundError as error:
            raise BackendError("particles_missing", f"There is no {path}.", hint="Run the job to its end.") from error
        except _DAMAGED as error:
            raise _damaged(self._path, "is cut off, or no HDF5 file") from error
        try:
            self._read_header()
        except BackendError:
            self.close()
            raise
        except _DAMAGED as error:
            self.close()
            raise _damaged(self._path, f"lacks a part or is damaged ({error})") from error

    def frame(self, index: int) -> ParticleFrame:
        """Frame `index`, counted from the first fitted one; forecast frames follow. Raises BackendError, IndexError."""
        if not 0 <= index < self.num_frames + self.num_forecast:
            raise IndexError(index)
        rows = slice(int(self._offsets[index]), int(self._offsets[index + 1]))
        try:
            values: dict[str, np.ndarray] = {name: dataset[rows] for name, dataset in self._datasets.items()}
            frame = ParticleFrame(**values)
            _check_frame(frame, self._columns, name=f"frame {index}")
        except _DAMAGED as error:
            raise _damaged(self._path, f"cannot be read at frame {index} ({error})") from error
        return frame

    def close(self) -> None:
        self._file.close()

    def __enter__(self) -> Particles:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _read_header(self) -> None:
        file: Any = self._file
        if bytes(file.attrs.get("format", b"")) != FORMAT_NAME.encode():
            raise _damaged(self._path, "was not written by this program")
        version = int(file.attrs["format_version"])
        if version != PARTICLES_FORMAT_VERSION:
            raise BackendError(
                "particles_version",
                f"{self._path.name} has format version {version}; this program reads {PARTICLES_FORMAT_VERSION}.",
                hint="Use the version of the program that wrote it, or run the job again.",
            )
        self.num_frames = int(file.attrs["num_frames"])
        self.num_forecast = int(file.attrs["num_forecast"])
        self._columns = _columns("rotations" in file["particles"])
        self._datasets = {name: file["particles"][name] for name in self._columns}
        self._offsets = self._checked_offsets(file)
        identities = file["identities"]
        self.ids: np.ndarray = _bounded(identities["ids"], self._path)  # [K] int64, ascending
        self.birth_frames: np.ndarray = _bounded(identities["birth_frames"], self._path)  # [K] first frame alive
        self.death_frames: np.ndarray = _bounded(identities["death_frames"], self._path)  # [K] first frame no longer there
        if not len(self.ids) == len(self.birth_frames) == len(self.death_frames):
            raise ValueError("births and deaths do not match the ids")
        physics = file["physics"].attrs
        self.info = ParticlesInfo(
            cameras=parse_cameras(_read_text(file["cameras"], "json", self._path), name=f"{self._path.name}: cameras"),
            gravity=_vector(physics["gravity"]),
            frame_start=int(file.attrs["frame_start"]),
            buoyancy=_vector(physics["buoyancy"]),
            buoyancy_uncertainty=_vector(physics["buoyancy_uncertainty"]),
            fluid={name: float(value) for name, value in sorted(file["physics/fluid"].attrs.items())},
            light=_read_light(physics),
            provenance=json.loads(_read_text(file, "provenance", self._path)),
            fingerprint=str(file.attrs["fingerprint"]),
        )
        for name in ("camera_to_world", "intrinsics"):
            _check_size(file["cameras"][name], self._path)
        if DIGEST in file.attrs and str(file.attrs[DIGEST]) != header_digest(file):
            raise ValueError("its cameras, counts or provenance are not as they were written")

    def _checked_offsets(self, file: Any) -> np.ndarray:
        """offsets [T + 1], after a comparison of every count with what the file can hold."""
        offsets = _bounded(file["frames/offsets"], self._path)
        num_frames, num_forecast = self.num_frames, self.num_forecast
        if num_frames < 0 or num_forecast < 0 or offsets.shape != (num_frames + num_forecast + 1,):
            raise ValueError("the number of frames does not match")
        total = int(offsets[-1])
        if offsets[0] != 0 or np.any(np.diff(offsets) < 0):
            raise ValueError("frames overlap")
        for name, dataset in self._datasets.items():
            shape = self._columns[name][1]
            if dataset.shape != (total, *shape):
                raise ValueError(f"{name} has shape {dataset.shape} for {total} particles")
            _check_size(dataset, self._path)
        return offsets


def read_particles(path: str | Path) -> Particles:
    """Open a particles.h5. Raises BackendError if it is missing, damaged, or of another version."""
    return Particles(path)


class _Lives:
    """First and last frame of every id, as sorted arrays."""

    def __init__(self) -> None:
        self._ids = np.zeros(0, np.int64)
        self._births = np.zeros(0, np.int32)
        self._last = np.zeros(0, np.int32)

    def see(self, ids: np.ndarray, frame: int) -> None:
        """Note the ids of a frame. Raises ValueError where one comes twice, or comes back after it was gone."""
        seen = np.sort(np.asarray(ids, np.int64))
        if np.any(seen[1:] == seen[:-1]):
            raise ValueError(f"frame {frame}: an id occurs twice")
        known = np.isin(seen, self._ids, assume_unique=True)
        places = np.searchsorted(self._ids, seen[known])
        if np.any(self._last[places] != frame - 1):
            raise ValueError(f"frame {frame}: an id comes back after it was gone")
        self._last[places] = frame
        new = seen[~known]
        at = np.searchsorted(self._ids, new)
        self._ids = np.insert(self._ids, at, new)
        self._births = np.insert(self._births, at, frame)
        self._last = np.insert(self._last, at, frame)

    def write(self, group: Any, num_frames: int) -> None:
        _write_array(group, "ids", self._ids.astype("<i8"))
        _write_array(group, "birth_frames", self._births.astype("<i4"))
        _write_array(group, "death_frames", (self._last + 1).astype("<i4"))  # num_frames: alive to the end
        group.attrs["num_frames"] = num_frames


def _columns(is_anisotropic: bool) -> dict[str, tuple[str, tuple[int, ...]]]:
    return {**_COLUMNS, **_ANISOTROPIC} if is_anisotropic else dict(_COLUMNS)


def _check_frame(frame: ParticleFrame, columns: dict[str, tuple[str, tuple[int, ...]]], *, name: str) -> None:
    for column, (dtype, shape) in columns.items():
        array = np.asarray(getattr(frame, column))
        if array.shape != (frame.count, *shape):
            raise ValueError(f"{name}: {column} has shape {array.shape}, expected {(frame.count, *shape)}")
        if dtype == "<i8":
            if not np.issubdtype(array.dtype, np.integer):
                raise ValueError(f"{name}: {column} are {array.dtype}, expected whole numbers")
        elif not np.all(np.abs(array) <= np.finfo(dtype).max):
            raise ValueError(f"{name}: {column} hold NaN, infinity, or more than {dtype} can hold")
    if np.any(np.asarray(frame.scales, np.float32) <= 0) or np.any(np.asarray(frame.optical_masses) < 0):
        raise ValueError(f"{name}: a scale is not positive or an optical mass is negative")


def _write_cameras(group: Any, cameras: Cameras) -> None:
    _write_text(group, "json", cameras.to_json())
    _write_array(group, "camera_to_world", np.array(cameras.camera_to_world, "<f8"))
    intrinsics = _write_array(group, "intrinsics", np.array([cameras.fx, cameras.fy, cameras.cx, cameras.cy], "<f8"))
    intrinsics.attrs["unit"] = np.bytes_(b"px: fx, fy, cx, cy")
    group.attrs["width"], group.attrs["height"], group.attrs["fps"] = cameras.width, cameras.height, cameras.fps


def _write_physics(group: Any, info: ParticlesInfo) -> None:
    for name in ("gravity", "buoyancy", "buoyancy_uncertainty"):
        group.attrs[name] = np.array(_vector(getattr(info, name)), "<f8")
    fluid = group.create_group("fluid")
    for name in sorted(info.fluid):
        fluid.attrs[name] = float(info.fluid[name])
    _write_light(group.attrs, info.light)


def _write_light(attributes: Any, light: Light | None) -> None:
    for name, value in asdict(light).items() if light else ():
        attributes[_LIGHT + name] = np.array(value, "<f8")


def _read_light(attributes: Any) -> Light | None:
    found = {name.removeprefix(_LIGHT): attributes[name].tolist() for name in attributes if name.startswith(_LIGHT)}
    return parse_light(found) if found else None


def _write_text(group: Any, name: str, text: str) -> None:
    """Text as a scalar of fixed length: any HDF5 reader shows it, and its bytes follow from the text alone."""
    data = text.encode()
    _write_array(group, name, np.array(data, dtype=h5py.string_dtype("utf-8", max(len(data), 1))))


def _write_array(group: Any, name: str, array: np.ndarray) -> Any:
    """A small array; no time is stored with it."""
    return group.create_dataset(name, data=array, track_times=False)


def _read_text(group: Any, name: str, path: Path) -> str:
    _check_size(group[name], path)
    return bytes(group[name][()]).decode()


def _bounded(dataset: Any, path: Path) -> np.ndarray:
    """All of a small array of whole numbers, after a look at how large it claims to be."""
    _check_size(dataset, path)
    array = np.asarray(dataset[()])
    if array.ndim != 1 or not np.issubdtype(array.dtype, np.integer):
        raise ValueError(f"{dataset.name} is no list of whole numbers")
    return array


def _check_size(dataset: Any, path: Path) -> None:
    """A damaged count must not make us ask for the memory that it claims."""
    size = int(np.prod(dataset.shape, dtype=object)) * int(dataset.dtype.itemsize)
    if size > _MAX_COMPRESSION * path.stat().st_size:
        raise ValueError(f"{dataset.name} claims {size} bytes")


def _vector(values: Any) -> Vector:
    x, y, z = (float(value) for value in values)
    if not np.all(np.isfinite([x, y, z])):
        raise ValueError("a vector is not finite")
    return (x, y, z)


def _damaged(path: Path, problem: str) -> BackendError:
    return BackendError("particles_damaged", f"{path.name} {problem}.", hint="Run the job again; it writes the file anew.")
