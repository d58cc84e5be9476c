"""An HDF5 file that is whole or absent, on a full disk too."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import h5py

from backend.io.atomic import whole_file
from backend.io.hdf5_sink import Hdf5Sink


@contextmanager
def whole_hdf5(path: Path) -> Iterator[h5py.File]:
    """Gives an HDF5 file to write to; it appears under `path` on success only. Equal content makes equal bytes."""
    with ExitStack() as stack:
        part = stack.enter_context(whole_file(path))
        sink = Hdf5Sink(part)
        stack.callback(sink.check)
        stack.callback(sink.close)
        yield stack.enter_context(h5py.File(sink, "w", libver=("v110", "v110"), track_order=False))
