"""From a finished job to what the artist sees: volume, material, camera, light, preview."""

from .importing import import_result

__all__ = ["import_result"]
