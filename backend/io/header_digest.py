"""A digest of all in a particles.h5 that carries no checksum of its own: attributes, index arrays, cameras, provenance."""

from __future__ import annotations

import hashlib
from typing import Any

import numpy as np

DIGEST = "header_digest"  # root attribute: SHA-256 as hexadecimal digits
_GROUPS = ("frames", "identities", "cameras", "physics", "physics/fluid")  # particles/ has checksums
_TEXTS = ("provenance",)


def header_digest(file: Any) -> str:
    """Of an open HDF5 file. Whoever reads it has made sure that its datasets are as small as they claim."""
    found = hashlib.sha256()

    def add(name: str, value: Any) -> None:
        array = np.asarray(value)
        found.update(f"{name} {array.dtype.str} {array.shape} ".encode())
        found.update(array.astype(str).tobytes() if array.dtype.kind in "OU" else array.tobytes())

    for path in ("/", *_GROUPS):
        group = file[path]
        for name in sorted(group.attrs):
            if name != DIGEST:
                add(f"{path}@{name}", group.attrs[name])
        for name in sorted(group):
            if path != "/" and hasattr(group[name], "dtype"):
                add(f"{path}/{name}", group[name][()])
    for name in _TEXTS:
        add(name, file[name][()])
    return found.hexdigest()
