"""Which worker makes which file: several processes and machines share one folder, and no two make the same frame.

A worker creates NAME.claim exclusively before it works on NAME, and removes it afterwards. The claim of a worker that
died is taken over: at once on the same machine, on another one after its claim is older than a time limit.
"""

from __future__ import annotations

import json
import os
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from backend.contract.running import is_alive, process_start

STALE_SECONDS = 3 * 3600.0  # longer than any frame takes
_STALE_TEXT_SECONDS = 60.0  # longer than any small file takes


@contextmanager
def claimed(target: Path, *, stale_seconds: float = STALE_SECONDS) -> Iterator[bool]:
    """True while this process alone may make `target`; False where it exists or another one is at it."""
    claim = target.with_name(target.name + ".claim")
    if target.exists() or not _take(claim, stale_seconds):
        yield False
        return
    try:
        yield not target.exists()  # the other may have finished between our two looks
    finally:
        claim.unlink(missing_ok=True)


def write_once(path: Path, text: str) -> str:
    """Write a small file if there is none, or wait until another worker has; returns what it holds then."""
    while not path.exists():
        with claimed(path, stale_seconds=_STALE_TEXT_SECONDS) as is_ours:
            if is_ours:
                part = path.with_name(path.name + ".part")
                part.write_text(text, encoding="utf-8")
                part.replace(path)
        if not is_ours:
            time.sleep(0.01)
    return path.read_text(encoding="utf-8")


def _take(claim: Path, stale_seconds: float) -> bool:
    text = json.dumps({"host": socket.gethostname(), "pid": os.getpid(), "start": process_start(os.getpid())})
    if _create(claim, text):
        return True
    try:
        found, age = claim.read_text(encoding="utf-8"), time.time() - claim.stat().st_mtime
    except FileNotFoundError:
        return _create(claim, text)
    if not _is_stale(found, age, stale_seconds):
        return False
    # Renaming lets exactly one of several workers remove the stale claim. Should it have been replaced by a live one
    # between our look and our rename, that one is put back.
    removed = claim.with_name(f"{claim.name}.{socket.gethostname()}.{os.getpid()}")
    try:
        os.rename(claim, removed)
    except FileNotFoundError:
        return False
    is_ours = removed.read_text(encoding="utf-8") == found
    if not is_ours:
        with suppress(FileExistsError):  # a third has claimed it since
            os.link(removed, claim)
    removed.unlink()
    return is_ours and _create(claim, text)


def _create(claim: Path, text: str) -> bool:
    try:
        descriptor = os.open(claim, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o644)
    except FileExistsError:
        return False
    with os.fdopen(descriptor, "w", encoding="utf-8") as file:
        file.write(text)
    return True


def _is_stale(text: str, age: float, stale_seconds: float) -> bool:
    try:
        data = json.loads(text)
        host, pid, start = str(data["host"]), int(data["pid"]), data["start"]
    except (ValueError, KeyError, TypeError):
        return age > 60.0  # its worker died, or has not written it yet
    if host != socket.gethostname():
        return age > stale_seconds
    return not is_alive(pid) or (start is not None and process_start(pid) != start)
