"""Per-frame records of arrays: a folder of whole files while a stage runs, one HDF5 file when it is done.

A record is a dataclass of numpy arrays. The folder is what a stage resumes from: a frame's file is written only
when it is whole, and holds everything that the next frame depends on.
"""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, Generic, TypeVar

import h5py
import numpy as np

from backend.contract.errors import BackendError
from backend.contract.units import STAGE_FORMAT_VERSION
from backend.io.atomic import storage_errors, whole_file, write_text
from backend.io.hdf5_file import whole_hdf5

Record = TypeVar("Record")


class RecordFolder(Generic[Record]):
    """The frames of an unfinished stage, one file each, numbered from 0 without gaps."""

    def __init__(self, folder: Path, fingerprint: str, record_type: type[Record]) -> None:
        self.folder = folder
        self._type = record_type
        mark = folder / "fingerprint.txt"
        if not (mark.is_file() and mark.read_text(encoding="utf-8") == fingerprint):
            shutil.rmtree(folder, ignore_errors=True)
            with storage_errors(folder):
                folder.mkdir(parents=True)
            write_text(mark, fingerprint)

    def __len__(self) -> int:
        count = 0
        while self._path(count).is_file():
            count += 1
        return count

    def __getitem__(self, frame: int) -> Record:
        if not self._path(frame).is_file():
            raise IndexError(frame)
        with np.load(self._path(frame), allow_pickle=False) as arrays:
            return self._type(**{name: arrays[name] for name in arrays.files})

    def __iter__(self) -> Iterator[Record]:
        return (self[frame] for frame in range(len(self)))

    def save(self, frame: int, record: Record) -> None:
        with whole_file(self._path(frame)) as part, open(part, "wb") as handle:
            np.savez(handle, allow_pickle=False, **_arrays(record))

    def remove(self) -> None:
        shutil.rmtree(self.folder, ignore_errors=True)

    def _path(self, frame: int) -> Path:
        return self.folder / f"{frame:06d}.npz"


class RecordFile(Generic[Record]):
    """The frames of a finished stage, read one at a time. Raises BackendError where there is no such file."""

    def __init__(self, path: Path, record_type: type[Record]) -> None:
        self._file = open_stage_file(path)
        self._type = record_type

    def __len__(self) -> int:
        return int(self._file.attrs["num_frames"])  # type: ignore[arg-type]

    def __getitem__(self, frame: int) -> Record:
        if not 0 <= frame < len(self):
            raise IndexError(frame)
        group: Any = self._file[f"{frame:06d}"]
        return self._type(**{name: group[name][()] for name in group})

    def __iter__(self) -> Iterator[Record]:
        return (self[frame] for frame in range(len(self)))

    def close(self) -> None:
        self._file.close()

    def __enter__(self) -> RecordFile[Record]:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def write_records(path: Path, fingerprint: str, records: Iterable[Any]) -> None:
    """Pack records into one file, whole or absent."""
    with whole_hdf5(path) as file:
        count = 0
        for record in records:
            group = file.create_group(f"{count:06d}")
            for name, array in _arrays(record).items():
                group.create_dataset(name, data=array)
            count += 1
        file.attrs["num_frames"] = count
        stamp(file, fingerprint)


def stamp(file: h5py.File, fingerprint: str) -> None:
    """Write what a stage's file is known by."""
    file.attrs["format_version"] = STAGE_FORMAT_VERSION
    file.attrs["units"] = "SI, linear light; see docs/conventions.md"
    file.attrs["fingerprint"] = fingerprint


def read_stamp(path: Path) -> str | None:
    """The fingerprint of a stage's file; None if there is none or it is damaged (it is then made anew)."""
    if not path.is_file():
        return None
    try:
        with h5py.File(path, "r") as file:
            if int(file.attrs["format_version"]) != STAGE_FORMAT_VERSION:  # type: ignore[arg-type]
                return None
            return str(file.attrs["fingerprint"])
    except (OSError, KeyError, ValueError, TypeError, RuntimeError):
        return None


def open_stage_file(path: Path) -> h5py.File:
    """A finished stage's file for reading. Raises BackendError where there is none."""
    try:
        return h5py.File(path, "r")
    except OSError as error:
        raise BackendError(
            "not_finished", f"{path.name} is missing or damaged in {path.parent}.", hint="Run the job again; it resumes."
        ) from error


def _arrays(record: Any) -> dict[str, np.ndarray]:
    """By name; what a record may lack and lacks is not written, and read as lacking."""
    values = {item.name: getattr(record, item.name) for item in dataclasses.fields(record)}
    return {name: np.asarray(value) for name, value in values.items() if value is not None}
