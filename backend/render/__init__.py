"""The differentiable renderer of Gaussian particles. Never imports backend.physics."""

from backend import kernel_setup  # noqa: F401 before any kernel, see there
