"""Where the prior's trained weights lie, and what they are known by. Without torch: whether they are there is asked first."""

from __future__ import annotations

import hashlib
from pathlib import Path

from backend.contract.errors import BackendError

WEIGHTS = Path(__file__).resolve().parent / "plumes.npz"
HINT = "Install Wildsmoke again, or set volume.use_prior=false."


def weights_fingerprint(path: Path = WEIGHTS) -> str:
    """The content of the file: what is fitted with other weights is stale. Raises BackendError where there is none."""
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        message = f"The weights of the trained prior, {path}, are missing or cannot be read."
        raise BackendError("prior_missing", message, hint=HINT) from error
