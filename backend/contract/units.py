"""Units and the version of each file format. Everything is SI in a right-handed world with z up.

Lengths m, time s, velocity m/s, buoyancy m/s^2, extinction 1/m, optical mass m^2 (extinction integrated over
space), optical depth 1. Radiance is linear; names of sRGB-coded values end in `_srgb`. Pixel centres at +0.5.
Frames count from 0 everywhere; only Blender's frame numbers and VDB file names count from 1.
"""

from __future__ import annotations

JOB_FORMAT_VERSION = 1
STAGE_FORMAT_VERSION = 1
PARTICLES_FORMAT_VERSION = 1
RESULT_FORMAT_VERSION = 1

PARTICLES_UNITS = {
    "positions": "m",
    "velocities": "m/s",
    "scales": "m",
    "rotations": "1",
    "optical_masses": "m^2",
    "colors": "linear RGB",
    "buoyancy": "m/s^2",
    "gravity": "m/s^2",
}
VDB_UNITS = {"density": "1/m", "velocity": "m/s", "color": "linear RGB"}
