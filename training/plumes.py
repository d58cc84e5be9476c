"""Random smoke to learn from: a scene for each number, unlike the benchmark's, which are never seen in training.

Everything that a clip does not tell is drawn: how many sources, where, how hot, when they burn; wind, cooling, obstacles.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from synthetic.scenes import Obstacle, SmokeScene, Source

SIZE = (12.0, 12.0, 20.0)  # m
_LOWEST, _HIGHEST = 0.6, 2.4  # m, of a source
_WINDIER = 200  # from this number on
_BUSIER = 700  # from this number on: more sources, that light up while they are filmed
_FEW, _MANY = (0.65, 0.25, 0.1), (0.45, 0.35, 0.2)  # how often there are one, two and three sources
_REACH = 1.8  # m, of a source from the middle


def plume(seed: int) -> SmokeScene:
    """The scene of a number; the same for ever."""
    draw = np.random.default_rng([seed, 7])
    wind_speed, wind_angle = 1.2 * draw.random() ** 1.5, draw.uniform(0, 2 * math.pi)
    if seed >= _WINDIER:
        wind_speed *= 1.5 / max(wind_speed, 1e-3) ** (1 / 3)  # as often strong as weak
    wind = wind_speed * math.cos(wind_angle), wind_speed * math.sin(wind_angle)
    sources = tuple(_source(draw, wind) for _ in range(draw.choice([1, 2, 3], p=_MANY if seed >= _BUSIER else _FEW)))
    confinement, cooling = draw.uniform(0.3, 0.8), draw.uniform(4.0, 16.0)
    warm_up = draw.choice([0.0, draw.uniform(1.0, 6.0)], p=[0.3, 0.7])
    if seed >= _BUSIER:
        sources = tuple(_later(source, draw.uniform(0.0, warm_up)) for source in sources)
    return SmokeScene(
        name=f"plume_{seed:04d}",
        purpose="Training.",
        sources=sources,
        size=SIZE,
        wind=wind,
        confinement=confinement,
        cooling=cooling,
        warm_up=warm_up,
        obstacles=(_obstacle(draw, sources[0].position),) if draw.random() < 0.2 else (),
        seed=seed + 1000,
    )


def _source(draw: np.random.Generator, wind: tuple[float, float]) -> Source:
    x, y = (draw.uniform(-_REACH, _REACH) * 0.6 - 1.5 * speed for speed in wind)
    start = draw.choice([0.0, draw.uniform(0.0, 3.0)], p=[0.6, 0.4])
    burns = draw.choice([float("inf"), draw.uniform(2.0, 8.0)], p=[0.7, 0.3])
    return Source(
        position=(x, y, draw.uniform(_LOWEST, _HIGHEST)),
        radius=draw.uniform(0.25, 0.65),
        density=draw.uniform(2.5, 6.0),
        temperature=math.exp(draw.uniform(math.log(60.0), math.log(280.0))),
        rise=draw.uniform(0.3, 2.5),
        start=start,
        stop=start + burns,
        noise=draw.uniform(0.3, 1.0),
        turbulence=draw.uniform(2.0, 10.0),
    )


def _later(source: Source, delay: float) -> Source:
    """One that does not burn from the beginning lights up `delay` s later."""
    return source if source.start == 0.0 else replace(source, start=source.start + delay, stop=source.stop + delay)


def _obstacle(draw: np.random.Generator, source: tuple[float, float, float]) -> Obstacle:
    """A slab over the source or a block beside it."""
    length, depth, height = draw.uniform(0.8, 2.5), draw.uniform(0.8, 2.5), draw.uniform(0.5, 1.2)
    x, y = source[0] + draw.uniform(-1.2, 1.2), source[1] + draw.uniform(-1.2, 1.2)
    z = source[2] + draw.uniform(1.2, 3.5)
    return Obstacle(low=(x - 0.5 * length, y - 0.5 * depth, z), high=(x + 0.5 * length, y + 0.5 * depth, z + height))
