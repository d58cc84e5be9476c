"""Smoke and air on grids: what rays see of them, how they move. A fit works on them; the asset is made of particles."""

from backend import kernel_setup as kernel_setup
