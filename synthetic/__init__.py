"""The synthetic benchmark: smoke from a solver of its own, a procedural scene, and Cycles renders with full truth.

`solver/` and `clip.py` run in the backend's environment (numba, scipy, PyAV), `scene/` and `render.py` inside Blender
(bpy, numpy); the modules at this level are plain standard library and run in both. Nothing here imports the
renderer or the physics of the backend: truth made by the code under test proves nothing.
"""
