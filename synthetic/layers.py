"""What is rendered of a frame, how its file is called, and what it may cost."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum


class Layer(Enum):
    """clip: everything. smoke: smoke alone on black, its light premultiplied, 4th channel opacity. plate: no smoke.
    depth: distance along the optical axis, m, as EXR; the others are PNG, sRGB-coded, smoke with 16 bits."""

    CLIP = "clip"
    SMOKE = "smoke"
    PLATE = "plate"
    DEPTH = "depth"

    @property
    def suffix(self) -> str:
        return ".exr" if self is Layer.DEPTH else ".png"


@dataclass(frozen=True, slots=True, kw_only=True)
class Quality:
    """What an image costs. samples per pixel, opacity_samples: of the opacity of smoke alone; bounces of light in all and
    inside smoke; step_rate: ray marching steps per voxel, 1 (only where is_biased); threads: 0 for all."""

    samples: int
    opacity_samples: int = 16
    is_denoised: bool = True
    is_biased: bool = True
    bounces: int = 4
    volume_bounces: int = 8
    step_rate: float = 1.0
    threads: int = 0
