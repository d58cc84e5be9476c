"""The clip's light, as far as the smoke shows it: a far sun and an even rest."""

from __future__ import annotations

import math
from dataclasses import MISSING, dataclass, fields
from typing import Any

Vector = tuple[float, float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class Light:
    """What lights the smoke of a clip.

    direction: towards the sun, a unit vector in the world. sun, ambient: the linear RGB that thin smoke shows where all of the
    sun, all of the rest reaches it; the smoke's albedo is part of both, for one clip cannot tell them apart. softness: share of
    the extinction that counts as shadow, for scattered light goes round. explained: share of the variation of the smoke's
    colour that this light explains, on frames that it was not found on. doubt_degrees: how far, root mean square, directions
    are from this one that explain nearly as much. anisotropy: mean cosine of the angle by which the smoke turns the sun's light
    (Henyey and Greenstein 1941), as far as a camera that goes around it tells; sun_share: of the smoke's light, what is the
    sun's. Files of before these two were found have neither: their smoke looks alike from all sides.
    """

    direction: Vector
    sun: Vector
    ambient: Vector
    softness: float
    explained: float
    doubt_degrees: float
    anisotropy: float = 0.0
    sun_share: float = 0.0


def parse_light(data: Any) -> Light:
    """From what asdict made of one. Raises ValueError, TypeError or KeyError where it is none."""
    values: dict[str, Any] = {}
    for item in fields(Light):
        value = data[item.name] if item.default is MISSING else data.get(item.name, item.default)
        is_vector = item.name in ("direction", "sun", "ambient")
        numbers = tuple(float(part) for part in value) if is_vector else (float(value),)
        if len(numbers) != (3 if is_vector else 1) or not all(math.isfinite(number) for number in numbers):
            raise ValueError(f"the light's {item.name} is {value!r}")
        values[item.name] = numbers if is_vector else numbers[0]
    light = Light(**values)
    if abs(math.hypot(*light.direction) - 1.0) > 1e-3 or min(*light.sun, *light.ambient) < 0.0:
        raise ValueError("the light has no direction, or takes light away")
    if not (abs(light.anisotropy) < 1.0 and 0.0 <= light.sun_share <= 1.0):
        raise ValueError("the light goes on in no way that smoke knows")
    return light
