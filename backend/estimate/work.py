"""What a job has to do, stage by stage, in quantities that do not depend on the machine."""

from __future__ import annotations

import math
from dataclasses import dataclass

from backend.contract.job import Config
from backend.estimate.machine import HEIGHT, NUM_PARTICLES, WIDTH
from backend.fit.pace import gap_of, longest_stride
from backend.fit.region import FINER, ROUNDS, num_probes
from backend.fit.survey import Survey

USUAL_PARTS = 2.5  # of a frame's smoke, that the prior is asked about one by one when it looks closer
ONE_HUE_SHARE = 0.65  # of the time that three channels take to be drawn and differentiated


@dataclass(frozen=True, slots=True, kw_only=True)
class Term:
    """A quantity of a stage and the kind of work whose standard piece it is measured in; its coefficient is in costs.json."""

    name: str
    kind: str
    amount: float


def asks_prior(config: Config) -> bool:
    return config.volume.use_prior and config.method == "default"


def kinds_of(config: Config) -> list[str]:
    """The kinds of work of a job."""
    return ["splat", "pixels", "voxels", *(["network"] if asks_prior(config) else [])]


def pixels_of(seen: Survey, config: Config) -> int:
    """Of a frame at the size that is fitted."""
    share = min(1.0, config.frames.working_size / max(seen.source_size))
    return max(1, round(seen.source_size[0] * share)) * max(1, round(seen.source_size[1] * share))


def memory_terms(seen: Survey, config: Config) -> dict[str, float]:
    """What the peak of the process grows with."""
    pixels = pixels_of(seen, config)
    settings = config.visual if config.method == "default" else config.published
    return {
        "program": 1.0,
        "prior": float(asks_prior(config)),
        "source_megapixel": seen.source_size[0] * seen.source_size[1] / 1e6,
        "matte_megapixel": pixels / 1e6 * (seen.mode == "matte"),
        "particle": settings.num_particles / NUM_PARTICLES,
    }


def terms_of(seen: Survey, config: Config, *, threads: int) -> dict[str, list[Term]]:
    """Stage -> its terms. A frame's pixels and a frame's particles count in those of a standard piece."""
    count, ahead = seen.num_frames, config.forecast.num_frames
    pixels = pixels_of(seen, config) / (WIDTH * HEIGHT)
    settings = config.visual if config.method == "default" else config.published
    visual = settings.num_particles / NUM_PARTICLES
    terms = {
        "start": [Term(name="start", kind="pixels", amount=1.0)],
        "frames": [Term(name="write", kind="pixels", amount=count * pixels)],
        "smoke": [Term(name="write", kind="pixels", amount=count * pixels)],
    }
    if asks_prior(config):
        asked = math.ceil(count / gap_of(config.volume.every, stride=longest_stride(count)))
        parts, size = (USUAL_PARTS, FINER**2) if config.volume.finer else (0.0, 1.0)  # size: of pictures, for one
        looks = asked * (1.0 + parts) + ROUNDS * num_probes(asked)
        terms["volume"] = [
            Term(name="load", kind="pixels", amount=1.0),
            Term(name="propose", kind="network", amount=looks / max(1, min(threads, 8))),
            Term(name="frame", kind="pixels", amount=count * size),
        ]
    terms["physical"] = _physical(seen, config, pixels)
    terms["visual"] = _visual(seen, config, pixels, visual)
    terms["forecast"] = [
        Term(name="frame", kind="pixels", amount=float(ahead)),
        Term(name="particle", kind="voxels", amount=ahead * visual),
    ]
    terms["export"] = [
        Term(name="frame", kind="voxels", amount=float(count + ahead)),
        Term(name="particle", kind="voxels", amount=(count + ahead) * visual),
    ]
    return terms


def _physical(seen: Survey, config: Config, pixels: float) -> list[Term]:
    """Led by volumes the images are not asked how the smoke moves, nor is the fluid stepped."""
    count = seen.num_frames
    if config.method != "default":
        particles = config.published.num_physical / NUM_PARTICLES
        drawn = count * config.published.physical_iterations
        return [Term(name="published", kind="splat", amount=drawn * (particles + pixels))]
    particles = config.physical.num_particles / NUM_PARTICLES
    if asks_prior(config):
        return [
            Term(name="led_frame", kind="pixels", amount=float(count)),
            Term(name="led_particle", kind="splat", amount=count * particles),
        ]
    drawn = count * config.physical.correction_iterations
    return [
        Term(name="filtered_pixel", kind="pixels", amount=count * pixels),
        Term(name="filtered_particle", kind="splat", amount=count * particles),
        Term(name="correction", kind="splat", amount=drawn * (particles + seen.smoke_share * pixels)),
        Term(name="solver", kind="splat", amount=count * config.physical.solver_iterations * particles),
    ]


def _visual(seen: Survey, config: Config, pixels: float, particles: float) -> list[Term]:
    count = seen.num_frames
    if config.method != "default":
        drawn = count * config.published.visual_iterations
        return [Term(name="published", kind="splat", amount=drawn * (particles + pixels))]
    drawn, weighed = count * config.visual.iterations, count * config.visual.mass_iterations
    way = "led" if asks_prior(config) else "filtered"
    channels = ONE_HUE_SHARE if config.visual.color == "one_hue" else 1.0
    covered = seen.smoke_share * pixels
    return [
        Term(name=f"{way}_frame", kind="pixels", amount=float(count)),
        Term(name=f"{way}_pixel", kind="pixels", amount=count * pixels),
        Term(name=f"{way}_particle", kind="splat", amount=count * particles),
        Term(name="drawn_pixel", kind="splat", amount=drawn * channels * covered),
        Term(name="drawn_particle", kind="splat", amount=drawn * channels * particles),
        Term(name="mass_pixel", kind="splat", amount=weighed * covered),
        Term(name="mass_particle", kind="splat", amount=weighed * particles),
    ]
