"""The fluid: position-based dynamics of physical particles. Never imports backend.render."""
