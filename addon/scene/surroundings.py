"""World, light and colour management around the smoke."""

from __future__ import annotations

import math
from pathlib import Path

import bpy
from mathutils import Vector

from ...backend.contract.result import Result
from .material import hue_of
from .ownership import find_object, mark, owned_name

Color = tuple[float, float, float]

VOLUME_BOUNCES = 4  # fewer make lit smoke dark

# Light that makes a plume of albedo 0.95, lit (Relight 1), about as bright as it was filmed; found by rendering one.
_SUN_PER_RADIANCE = 9.0  # W/m^2, of what was filmed
_FOUND_SUN_PER_RADIANCE = 10.0  # W/m^2, of what thin smoke shows in full sun
_AMBIENT_PER_RADIANCE = 0.7
_USUAL_SUN = (-0.49, -0.41, 0.77)  # where the clip shows none: over the left shoulder of a camera that looks along +y


def ensure(scene: bpy.types.Scene, collection: bpy.types.Collection, job: Path, result: Result) -> None:
    """A World, without which Blender 5 draws no smoke, and a sun for relighting: the clip's, where its smoke showed one. What
    is there already stays."""
    sun_color, energy, sky = _light_of(result)
    ensure_world(scene, ambient=sky)
    if find_object(job, "sun") is not None:
        return
    light = bpy.data.lights.new(owned_name(job, "Sun"), "SUN")
    light.energy, light.color = energy, sun_color
    light.angle = math.radians(2.0)
    sun = bpy.data.objects.new(light.name, light)
    low, high = (Vector(corner) for corner in result.bounds)
    towards = Vector(result.light.direction if result.light else _USUAL_SUN).normalized()
    sun.location = (low + high) / 2 + towards * ((high - low).length or 1.0)
    sun.rotation_euler = towards.to_track_quat("Z", "Y").to_euler()  # a sun shines along its -z
    mark(sun, job, "sun")
    collection.objects.link(sun)


def _light_of(result: Result) -> tuple[Color, float, Color]:
    """The sun's colour, its strength in W/m^2, and the world's radiance; what hue they share and is the smoke's own is taken
    out of them."""
    if result.light is None:
        brightest = max(*result.smoke_color, 0.05)
        ambient = _AMBIENT_PER_RADIANCE * brightest
        return (1.0, 1.0, 1.0), _SUN_PER_RADIANCE * brightest, (ambient, ambient, ambient)
    hue = [max(channel, 1e-3) for channel in hue_of(result)]
    sun = [channel / share for channel, share in zip(result.light.sun, hue, strict=True)]
    r, g, b = (_AMBIENT_PER_RADIANCE * channel / share for channel, share in zip(result.light.ambient, hue, strict=True))
    strength = max(*sun, 1e-6)
    return (sun[0] / strength, sun[1] / strength, sun[2] / strength), _FOUND_SUN_PER_RADIANCE * strength, (r, g, b)


def ensure_world(scene: bpy.types.Scene, *, ambient: Color = (0.0, 0.0, 0.0)) -> None:
    """An even world where there is none; black by default."""
    if scene.world is not None:
        return
    world = bpy.data.worlds.new("World")
    world.use_nodes = True
    background = world.node_tree.nodes.get("Background")
    if background is not None:
        background.inputs["Color"].default_value = (*ambient, 1.0)
    scene.world = world


def match_look(scene: bpy.types.Scene) -> None:
    """Cycles, transparent film, and colours that come out as they went in: the clip's, not a film stock's."""
    scene.render.engine = "CYCLES"
    scene.render.film_transparent = True
    scene.view_settings.view_transform = "Standard"
    scene.view_settings.look = "None"
    scene.view_settings.exposure, scene.view_settings.gamma = 0.0, 1.0
    scene.cycles.volume_bounces = max(scene.cycles.volume_bounces, VOLUME_BOUNCES)
    if hasattr(scene.cycles, "volume_biased"):  # Blender 5: ray marching; looks the same and is several times cheaper
        scene.cycles.volume_biased = True
