"""What must be settled before numba loads: how waiting threads behave, and where machine code is kept.

Imported first by the packages that hold kernels (backend.render, backend.physics, backend.field). A user's own settings stand.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import sys
import time
from pathlib import Path

KERNEL_FOLDERS = ("render", "physics", "field")
KEPT_SECONDS = 30 * 24 * 3600.0  # machine code of other versions that was not used for so long is removed


def settle() -> None:
    """Set the environment of this process, where the user has not."""
    # Threads that wait must sleep, not spin: beside another busy program (Blender, say) spinning made each kernel ten
    # times slower. libgomp reads this when it loads.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    # Where a TBB lies about, as in Blender's own Python, numba would take it; on one processor it then waits for ever when
    # the program ends (https://github.com/numba/numba/issues/10556).
    os.environ.setdefault("NUMBA_THREADING_LAYER_PRIORITY", "omp tbb workqueue")
    # Threads of products of many points with a small matrix spin, too; and one thread gives the same bytes everywhere.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # numba looks only at the file of a kernel, not at what it inlines from others: after an update it would go on
    # with stale machine code. So each version of all the kernels' sources has a folder of its own.
    if "NUMBA_CACHE_DIR" not in os.environ:
        os.environ["NUMBA_CACHE_DIR"] = str(cache_folder())


def cache_folder() -> Path:
    """The folder for machine code of exactly these sources; those of old versions are cleared away."""
    own = caches_home() / f"kernels-{sources_fingerprint()}"
    if own.is_dir():
        os.utime(own)
    elif own.parent.is_dir():
        for other in own.parent.glob("kernels-*"):
            if time.time() - other.stat().st_mtime > KEPT_SECONDS:
                shutil.rmtree(other, ignore_errors=True)
    return own


def sources_fingerprint() -> str:
    """Sixteen hexadecimal digits that change with any source file of the kernels."""
    digest = hashlib.sha256()
    for folder in KERNEL_FOLDERS:
        for path in sorted((Path(__file__).parent / folder).glob("*.py")):
            digest.update(path.name.encode())
            digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def caches_home() -> Path:
    """Where this system keeps what can be made again."""
    if sys.platform == "win32":
        base = os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local"
    elif sys.platform == "darwin":
        base = Path.home() / "Library" / "Caches"
    else:
        base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "wildsmoke"


settle()
