"""What Cycles renders: a procedural static scene, the smoke volume, the camera. Runs inside Blender."""
