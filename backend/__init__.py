"""The compute backend: reads a video of smoke, fits moving particles to it and writes the asset.

It runs as its own process and never imports bpy. Only `backend.contract` is shared with Blender.
"""

__version__ = "0.1.0"
