"""Names for the content of files."""

from __future__ import annotations

import hashlib
from pathlib import Path


def content_fingerprint(files: list[Path]) -> str:
    """SHA-256 over the files' contents in order, read in pieces. The files' names and places do not matter."""
    digest = hashlib.sha256()
    for file in files:
        with open(file, "rb") as handle:
            digest.update(hashlib.file_digest(handle, "sha256").digest())
    return digest.hexdigest()
