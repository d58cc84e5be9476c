"""A file for h5py to write to that survives a full disk.

When the disk is full, HDF5 fails again for every object that is released afterwards, prints a page for each, and
ends the process with a bus error when Python exits. So the failure is kept from it: the first one is remembered, what
follows goes nowhere, and the one who writes asks with `check`.
"""

from __future__ import annotations

import os
from pathlib import Path


class Hdf5Sink:
    """Give it to h5py.File in place of a name; call `check` after each write and after the file was closed."""

    def __init__(self, path: Path) -> None:
        self._file = open(path, "w+b", buffering=0)  # noqa: SIM115 closed in close()
        self._error: OSError | None = None

    def check(self) -> None:
        """Raise what went wrong so far, if anything."""
        if self._error is not None:
            raise self._error

    def close(self) -> None:
        self._file.close()

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        return self._file.seek(offset, whence)

    def tell(self) -> int:
        return self._file.tell()

    def read(self, size: int = -1) -> bytes:
        """h5py takes for a file what has `read`; it calls `readinto`."""
        return self._file.read(size)

    def readinto(self, buffer: memoryview) -> int:
        """Bytes that were never written because of an error read as zero."""
        count = self._file.readinto(buffer) or 0
        if self._error is not None and count < len(buffer):
            buffer[count:] = bytes(len(buffer) - count)
            return len(buffer)
        return count

    def write(self, data: memoryview) -> int:
        rest = memoryview(data)
        while self._error is None and len(rest):
            try:
                rest = rest[self._file.write(rest) :]
            except OSError as error:
                self._error = error
        return len(data)

    def truncate(self, size: int) -> int:
        if self._error is None:
            try:
                return self._file.truncate(size)
            except OSError as error:
                self._error = error
        return size

    def flush(self) -> None:
        """Nothing is held back here."""
