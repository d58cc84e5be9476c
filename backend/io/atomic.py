"""Files that are whole or absent: write beside, fsync, rename."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from backend.contract.errors import BackendError

_FULL = (errno.ENOSPC, errno.EFBIG, getattr(errno, "EDQUOT", errno.ENOSPC))


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Gives the name to write to; on success the file appears under `path`, on failure nothing does.

    Raises BackendError "disk_full" or "not_writable" where the system refuses.
    """
    part = path.with_name(path.name + ".part")
    try:
        with storage_errors(path):
            part.unlink(missing_ok=True)
            yield part
            with open(part, "rb") as handle:
                os.fsync(handle.fileno())
            os.replace(part, path)
            _sync_folder(path.parent)
    except BaseException:
        _remove_quietly(part)
        raise


@contextmanager
def storage_errors(path: Path) -> Iterator[None]:
    """Turns a full disk and a forbidden folder into sentences. HDF5 reports them only in its text."""
    try:
        yield
    except (OSError, RuntimeError) as error:
        number = getattr(error, "errno", None)
        text = str(error)
        if number in _FULL or any(f"errno = {code}," in text for code in _FULL):
            raise BackendError(
                "disk_full",
                f"There is no room to write {path.name} in {path.parent}.",
                hint="Free some space, or choose another job folder; what was computed is kept and the next run resumes.",
            ) from error
        if number in (errno.EACCES, errno.EPERM, errno.EROFS) or any(f"errno = {code}," in text for code in (13, 1, 30)):
            raise BackendError(
                "not_writable",
                f"{path.name} cannot be written in {path.parent}.",
                hint="Choose a job folder that you may write to.",
            ) from error
        raise


def write_text(path: Path, text: str) -> None:
    """A small text file, whole or absent."""
    with whole_file(path) as part:
        part.write_text(text, encoding="utf-8", newline="\n")


def _sync_folder(folder: Path) -> None:
    """Make the rename itself durable, where the system can."""
    if os.name != "posix":
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _remove_quietly(path: Path) -> None:
    """Leave no debris behind an error that is already on its way."""
    try:
        path.unlink(missing_ok=True)
    except OSError:
        return
