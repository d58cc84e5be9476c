"""Writes one .vdb file with OpenVDB's Python module. Standard library, numpy and openvdb, nothing else.

backend/io/vdb.py imports this where the module can be loaded, and otherwise runs this file under a Python that has it:

    python openvdb_file.py grids.npz smoke.vdb
"""

from __future__ import annotations

import errno
import hashlib
import importlib
import json
import os
import struct
import sys
import uuid
from pathlib import Path
from types import ModuleType

import numpy as np

MODULE_NAMES = ("openvdb", "pyopenvdb")  # the second is Debian's older one

_MAGIC = b" BDV\0\0\0\0"
_UUID = slice(21, 57)  # after magic, file version, library version and one flag: 8 + 4 + 8 + 1 bytes
_HALF_MAX = 60000.0  # float16 ends at 65504
_HALF_MIN = 4e-3  # float16 steps by 6e-8 near zero: 1.5e-5 of a peak this high


def import_openvdb() -> ModuleType | None:
    """The module of this Python, None if it has none. A bpy wheel carries one that is not on the search path."""
    for name in MODULE_NAMES:
        try:
            return importlib.import_module(name)
        except ImportError:
            continue
    return None


def wheel_folders(site_packages: Path) -> list[Path]:
    """Where a bpy wheel in `site_packages` keeps the modules that it bundles, for this Python; newest first."""
    tail = f"python/lib/python{sys.version_info.major}.{sys.version_info.minor}/site-packages"
    return sorted(site_packages.glob(f"bpy/*/{tail}"), reverse=True)


def write_grids(module: ModuleType, path: Path, grids: dict[str, np.ndarray], transform: list[list[float]]) -> None:
    """Write dense grids, cropped to what is not zero. Same input, same bytes.

    grids: name -> [X, Y, Z] or [X, Y, Z, 3]; transform: 4x4 in OpenVDB's order (row vectors), voxel index -> m.
    """
    made = [_grid(module, name, array, transform) for name, array in grids.items()]
    module.write(str(path), grids=made)
    made.clear()  # a grid that outlives the interpreter makes the binding report leaks
    data = path.read_bytes()
    _check_whole(data, path)
    with open(path, "r+b") as file:
        file.write(_with_derived_uuid(data))


def read_grid(module: ModuleType, path: Path, name: str) -> tuple[np.ndarray, list[list[float]]]:
    """Values float32 [X, Y, Z] or [X, Y, Z, 3] of the box of active voxels, and its 4x4 transform (row vectors), index -> m.

    Raises OSError, RuntimeError or LookupError (by version of the module) where the file or the grid is missing or broken.
    """
    if not path.is_file():  # some versions of the module end the process otherwise
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(path))
    grid = module.read(str(path), name)
    low, high = grid.evalActiveVoxelBoundingBox() if grid.activeVoxelCount() else ((0, 0, 0), (0, 0, 0))
    shape = [b - a + 1 for a, b in zip(low, high, strict=True)]
    is_vector = grid.valueTypeName.startswith("vec3")
    values = np.zeros((*shape, 3) if is_vector else shape, np.float32)
    grid.copyToArray(values, ijk=tuple(low))
    corner = np.array(grid.transform.indexToWorld(tuple(low)))
    rows = []
    for axis in range(3):
        index = [place + (other == axis) for other, place in enumerate(low)]
        rows.append([*(np.array(grid.transform.indexToWorld(tuple(index))) - corner), 0.0])
    return values, [*rows, [*corner, 1.0]]


def _grid(module: ModuleType, name: str, array: np.ndarray, transform: list[list[float]]) -> object:
    is_vector = array.ndim == 4
    grid = module.Vec3SGrid() if is_vector else module.FloatGrid()
    occupied = np.any(array, axis=3) if is_vector else array != 0
    if occupied.any():
        low, high = _bounding_box(occupied)
        cropped = array[low[0] : high[0], low[1] : high[1], low[2] : high[2]]
        # copyFromArray ignores strides, silently: it must get contiguous float32.
        grid.copyFromArray(np.ascontiguousarray(cropped, np.float32), ijk=low)
    grid.name = name
    grid.transform = module.createLinearTransform(transform)
    grid.gridClass = module.GridClass.UNKNOWN if is_vector else module.GridClass.FOG_VOLUME
    peak = max(float(array.max(initial=0.0)), -float(array.min(initial=0.0)))
    grid.saveFloatAsHalf = peak == 0.0 or _HALF_MIN <= peak <= _HALF_MAX
    return grid


def _bounding_box(occupied: np.ndarray) -> tuple[tuple[int, int, int], tuple[int, int, int]]:
    """First voxel and one past the last voxel of a mask [X, Y, Z] that is not empty."""
    low, high = [], []
    for axis in range(3):
        others = tuple(other for other in range(3) if other != axis)
        places = np.flatnonzero(occupied.any(axis=others))
        low.append(int(places[0]))
        high.append(int(places[-1]) + 1)
    return (low[0], low[1], low[2]), (high[0], high[1], high[2])


def _check_whole(data: bytes, path: Path) -> None:
    """OpenVDB says nothing when the disk is full. Every grid's head tells where it ends; the last one ends the file.

    Raises OSError (no space left) where the file is shorter than that.
    """
    try:
        position = _UUID.stop
        num_metadata, num_grids = struct.unpack_from("<II", data, position)
        if data[:8] != _MAGIC or num_metadata:
            raise RuntimeError(f"{path} has a header that is not known")
        position += 8
        for _ in range(num_grids):
            for _ in ("name", "type", "instance of"):
                position += 4 + struct.unpack_from("<I", data, position)[0]
            _, _, position = struct.unpack_from("<qqq", data, position)
    except struct.error:
        position = -1
    if position != len(data):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))


def _with_derived_uuid(data: bytes) -> bytes:
    """OpenVDB names each file by a random number; one derived from the content makes equal files equal."""
    blank = data[: _UUID.start] + b"0" * 36 + data[_UUID.stop :]
    name = str(uuid.UUID(bytes=hashlib.sha256(blank).digest()[:16])).upper().encode()
    return data[: _UUID.start] + name + data[_UUID.stop :]


def main(arguments: list[str]) -> int:
    """Write arguments[1] from the arrays in arguments[0]. Exit code 3: this Python has no openvdb; 4: the disk is full."""
    for folder in [entry for site in map(Path, sys.path) for entry in wheel_folders(site)]:
        sys.path.append(str(folder))
    module = import_openvdb()
    if module is None:
        return 3
    with np.load(arguments[0], allow_pickle=False) as arrays:
        transform = json.loads(str(arrays["transform"]))
        names = json.loads(str(arrays["names"]))
        grids = {name: arrays[f"grid_{index}"] for index, name in enumerate(names)}
    try:
        write_grids(module, Path(arguments[1]), grids, transform)
    except OSError as error:
        if error.errno == errno.ENOSPC:
            return 4
        raise
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
