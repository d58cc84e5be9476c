"""The compute backend: reads a video of smoke, fits moving particles to it and writes the asset.

It runs as its own process and never imports bpy. Only `backend.contract` is shared with Blender.
"""

import os

__version__ = "0.1.0"

# Threads that wait must sleep, not spin: with another program busy (Blender, say), spinning made each kernel ten times
# slower. libgomp reads this when it loads, so it is set before anything can load it; a user's own choice stands.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")
