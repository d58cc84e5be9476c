"""The smoke scenes by name: what burns, how hot, how the wind blows. Plain data, lengths in metres.

World: z up, the ground at z = 0, the (first) source near the z axis.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

SUN_AZIMUTH = 190.0  # degrees; from the left for the training sweep, then from behind: shaded sides, lit edges
SUN_ELEVATION = 30.0  # degrees: low enough to model the smoke and to throw its shadow into view
GRAVITY = 9.81  # m/s^2
AIR_TEMPERATURE = 293.0  # K


def towards_sun() -> tuple[float, float, float]:
    """Unit vector; the sun of all scenes."""
    azimuth, elevation = math.radians(SUN_AZIMUTH), math.radians(SUN_ELEVATION)
    return math.cos(elevation) * math.cos(azimuth), math.cos(elevation) * math.sin(azimuth), math.sin(elevation)


@dataclass(frozen=True, slots=True, kw_only=True)
class Source:
    """A ball in which smoke and heat are made between start and stop, s after the simulation begins (warm-up included).

    density: extinction the source fills up to, 1/m; temperature: excess over the air, K; rise: exit velocity, m/s.
    noise: strength of its flicker, 0 steady .. 1; turbulence: acceleration that stirs the air in it, m/s^2.
    """

    position: tuple[float, float, float]
    radius: float
    density: float = 4.5
    temperature: float = 130.0
    rise: float = 1.0
    start: float = 0.0
    stop: float = float("inf")
    noise: float = 0.7
    turbulence: float = 6.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Obstacle:
    """A solid box between two corners, m. Smoke flows around it; the rendered scene shows it."""

    low: tuple[float, float, float]
    high: tuple[float, float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class SmokeScene:
    """What the solver needs to know.

    size: width, depth, height of the box of air, m, its floor at z = 0 and its middle at (centre, z axis).
    wind: at 10 m height, m/s; less below (power law). confinement: strength of vorticity confinement, 1.
    cooling: time in which hot smoke loses its heat, s. warm_up: seconds simulated before the first frame.
    albedo: share of light that smoke scatters on, linear RGB.
    """

    name: str
    purpose: str
    sources: tuple[Source, ...]
    size: tuple[float, float, float] = (12.0, 12.0, 20.0)
    centre: tuple[float, float] = (0.0, 0.0)
    wind: tuple[float, float] = (0.0, 0.0)
    confinement: float = 0.5
    cooling: float = 8.0
    warm_up: float = 0.0
    obstacles: tuple[Obstacle, ...] = ()
    albedo: tuple[float, float, float] = (0.5, 0.49, 0.48)
    seed: int = 1


CHIMNEY_TOP = 2.0  # m, height of the rendered chimneys that sources sit in

_CHIMNEY = Source(position=(0.0, 0.0, CHIMNEY_TOP), radius=0.42, temperature=220.0, rise=2.0)

_ALL = (
    SmokeScene(
        name="steady_plume",
        purpose="A thick plume that has stood for a while: the inside is hidden, nothing but texture shows motion.",
        sources=(replace(_CHIMNEY, radius=0.5, density=5.0),),
        wind=(0.5, 0.3),
        warm_up=5.0,
        seed=21,
    ),
    SmokeScene(
        name="puff_front",
        purpose="A front that starts in view and whose source dies: birth, growth and thinning must be found.",
        sources=(replace(_CHIMNEY, start=0.4, stop=5.0),),
        wind=(0.35, -0.2),
        seed=22,
    ),
    SmokeScene(
        name="wind_wisp",
        purpose="A thin wisp that the wind bends: faint, mostly transparent, moving sideways faster than up.",
        sources=(replace(_CHIMNEY, position=(-2.0, -1.2, CHIMNEY_TOP), radius=0.28, density=4.0, rise=1.5),),
        size=(14.0, 12.0, 20.0),
        centre=(1.0, 0.4),
        wind=(0.95, 0.55),
        warm_up=4.0,
        seed=23,
    ),
    SmokeScene(
        name="merging_sources",
        purpose="Two sources at different depths whose plumes lean together and merge: which smoke is in front?",
        sources=(
            replace(_CHIMNEY, position=(-0.95, -0.6, CHIMNEY_TOP), radius=0.36),
            replace(_CHIMNEY, position=(0.95, 0.6, CHIMNEY_TOP), radius=0.36, temperature=160.0, start=1.0),
        ),
        wind=(0.2, 0.4),
        warm_up=1.5,
        seed=24,
    ),
    SmokeScene(
        name="obstacle_plume",
        purpose="A ground fire under a slab: smoke spreads below it, curls around its edges and joins above.",
        sources=(Source(position=(0.0, 0.0, 0.6), radius=0.45, density=4.0, temperature=200.0, rise=1.0),),
        obstacles=(Obstacle(low=(-1.6, -1.2, 3.4), high=(0.8, 1.2, 4.0)),),
        wind=(0.3, 0.1),
        warm_up=2.0,
        seed=25,
    ),
    SmokeScene(
        name="demo",
        purpose="The bundled clip: a plume that starts in view of a camera on a tripod.",
        sources=(replace(_CHIMNEY, radius=0.6),),
        albedo=(0.9, 0.885, 0.87),
        size=(9.0, 7.0, 13.0),
        centre=(1.2, 0.4),
        wind=(0.9, 0.3),
        confinement=0.5,
        seed=11,
    ),
)

SCENES = {scene.name: scene for scene in _ALL}
