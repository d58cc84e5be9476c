"""The fluid: position-based dynamics of physical particles. Never imports backend.render."""

from backend import kernel_setup  # noqa: F401 before any kernel, see there
