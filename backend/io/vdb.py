"""VDB files. The one place that knows where OpenVDB's Python module is, and how arrays lie in a grid.

Looked for in this order: the folder that WILDSMOKE_OPENVDB_PATH names; an installed `openvdb` (or `pyopenvdb`); the
one that the bpy wheel of a sibling environment bundles (without importing bpy); another Python that has it, named by
WILDSMOKE_VDB_PYTHON, to which the arrays are handed. A module built for another version of Python does not load and is
passed over: Blender names its folder and its Python together. PyPI has no wheel of OpenVDB to depend on.
"""

from __future__ import annotations

import errno
import functools
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import numpy as np

from backend.contract.errors import BackendError
from backend.io import openvdb_file
from backend.io.atomic import whole_file

PATH_VARIABLE = "WILDSMOKE_OPENVDB_PATH"
PYTHON_VARIABLE = "WILDSMOKE_VDB_PYTHON"

_CHECKOUT = Path(__file__).resolve().parents[2]
_WRITER_SECONDS = 600.0


def write_vdb(
    path: str | Path,
    grids: Mapping[str, np.ndarray],  # name -> [X, Y, Z], or [X, Y, Z, 3] for vectors
    *,
    voxel_size: float,  # m
    origin: tuple[float, float, float],  # m, centre of voxel (0, 0, 0)
) -> None:
    """Write one VDB file, whole or not at all. A grid of zeros, or without a voxel, becomes an empty grid.

    Voxel (i, j, k) has its centre at origin + voxel_size (i, j, k). Raises BackendError, ValueError.
    """
    arrays = {name: _checked(name, array) for name, array in grids.items()}
    transform = _transform(voxel_size, origin)
    with whole_file(Path(path)) as part:
        module = openvdb_module()
        if module is not None:
            openvdb_file.write_grids(module, part, arrays, transform)
        else:
            _write_elsewhere(writer_python(), part, arrays, transform)


@dataclass(frozen=True, slots=True, kw_only=True)
class DenseGrid:
    """values: [X, Y, Z] or [X, Y, Z, 3]; voxel (i, j, k) has its centre at origin + voxel_size (i, j, k), m."""

    values: np.ndarray
    voxel_size: float
    origin: tuple[float, float, float]


def read_vdb(path: str | Path, name: str) -> DenseGrid:
    """One grid of a VDB file, cropped to its active voxels (one voxel of background where there is none).

    Raises BackendError where the file or the grid is missing, the voxels are no cubes along the axes, or this Python has no
    OpenVDB module.
    """
    module = openvdb_module()
    if module is None:
        raise BackendError(
            "openvdb_missing",
            f"OpenVDB's Python module was not found for Python {sys.version_info.major}.{sys.version_info.minor}.",
            hint=f"Set {PATH_VARIABLE} to a folder that holds the module for this version of Python.",
        )
    try:
        values, transform = openvdb_file.read_grid(module, Path(path), name)
    except (OSError, RuntimeError, LookupError) as error:
        raise BackendError(
            "vdb_unreadable", f"{path} has no grid {name} that can be read: {error}.", hint="Give a whole VDB file."
        ) from error
    matrix = np.array(transform)
    size = matrix[0, 0]
    if not (size > 0 and np.allclose(matrix[:3, :3], size * np.eye(3), atol=1e-6 * abs(size))):
        raise BackendError("vdb_turned", f"The voxels of {path} are no cubes along the axes.", hint="Resample the grid first.")
    return DenseGrid(
        values=values, voxel_size=float(size), origin=(float(matrix[3, 0]), float(matrix[3, 1]), float(matrix[3, 2]))
    )


def check_writable() -> str:
    """Where VDB files will be written: the module's path, or the other Python's. Raises BackendError if nowhere."""
    module = openvdb_module()
    return str(module.__file__) if module is not None else str(writer_python())


def openvdb_module() -> ModuleType | None:
    """OpenVDB's module in this process, None if there is none for this version of Python."""
    return _find_module(os.environ.get(PATH_VARIABLE, ""))


def writer_python() -> Path:
    """The other Python that writes VDB files. Raises BackendError where none is named."""
    name = os.environ.get(PYTHON_VARIABLE, "")
    if not name:
        raise BackendError(
            "openvdb_missing",
            f"OpenVDB's Python module was not found for Python {sys.version_info.major}.{sys.version_info.minor}.",
            hint=f"Set {PYTHON_VARIABLE} to the Python inside Blender's folder, or start the job from Blender, which does so.",
        )
    path = Path(name)
    if not path.is_file():
        raise BackendError(
            "openvdb_missing",
            f"{PYTHON_VARIABLE} names {name}, which is no file.",
            hint="Name the Python inside Blender's folder.",
        )
    return path


@functools.cache
def _find_module(named_folder: str) -> ModuleType | None:
    module = _import_from([Path(named_folder)] if named_folder else [])
    if module is not None:
        return module
    version = f"python{sys.version_info.major}.{sys.version_info.minor}"
    sites = [environment / "lib" / version / "site-packages" for environment in sorted((_CHECKOUT / ".venv").glob("*"))]
    sites += [environment / "Lib" / "site-packages" for environment in sorted((_CHECKOUT / ".venv").glob("*"))]
    return _import_from([folder for site in sites for folder in openvdb_file.wheel_folders(site)])


def _import_from(folders: list[Path]) -> ModuleType | None:
    """Import the module with `folders` on the search path, and only while it is imported: they hold more than openvdb."""
    before = list(sys.path)
    sys.path[:0] = [str(folder) for folder in folders]
    try:
        return openvdb_file.import_openvdb()
    finally:
        sys.path[:] = before


def _write_elsewhere(python: Path, part: Path, arrays: dict[str, np.ndarray], transform: list[list[float]]) -> None:
    with tempfile.TemporaryDirectory(dir=part.parent, prefix="vdb_") as folder:
        handed_over = Path(folder) / "grids.npz"
        columns = {f"grid_{index}": array for index, array in enumerate(arrays.values())}
        with open(handed_over, "wb") as file:
            np.savez(file, allow_pickle=False, transform=json.dumps(transform), names=json.dumps(list(arrays)), **columns)
        command = [str(python), "-E", openvdb_file.__file__, str(handed_over), str(part)]
        try:
            done = subprocess.run(
                command, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=_WRITER_SECONDS, check=False
            )
        except (OSError, subprocess.TimeoutExpired) as error:
            raise _writer_failed(python, str(error)) from error
    if done.returncode == 4:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(part))
    if done.returncode == 3:
        raise _writer_failed(python, "it has no OpenVDB module")
    if done.returncode != 0:
        raise _writer_failed(python, (done.stderr.strip().splitlines() or ["no message"])[-1])


def _writer_failed(python: Path, problem: str) -> BackendError:
    return BackendError(
        "vdb_writer_failed",
        f"{python} could not write the VDB file: {problem}.",
        hint=f"Set {PYTHON_VARIABLE} to the Python inside Blender's folder; it has numpy and openvdb.",
    )


def _checked(name: str, array: np.ndarray) -> np.ndarray:
    values = np.asarray(array, np.float32)
    if values.ndim not in (3, 4) or (values.ndim == 4 and values.shape[3] != 3):
        raise ValueError(f"grid {name} has shape {values.shape}, expected [X, Y, Z] or [X, Y, Z, 3]")
    if not np.isfinite(values).all():
        raise ValueError(f"grid {name} holds NaN or infinity")
    return values


def _transform(voxel_size: float, origin: tuple[float, float, float]) -> list[list[float]]:
    """4x4, voxel index (row vector) -> world. OpenVDB's index (i, j, k) is a voxel's centre."""
    x, y, z = (float(value) for value in origin)
    if not (np.isfinite([x, y, z, voxel_size]).all() and voxel_size > 0):
        raise ValueError(f"voxel_size {voxel_size} or origin {origin} is not usable")
    s = float(voxel_size)
    return [[s, 0.0, 0.0, 0.0], [0.0, s, 0.0, 0.0], [0.0, 0.0, s, 0.0], [x, y, z, 1.0]]
