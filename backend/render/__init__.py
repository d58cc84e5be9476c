"""The differentiable renderer of Gaussian particles. Never imports backend.physics."""
