"""World, light and colour management around the smoke."""

from __future__ import annotations

import math
from pathlib import Path

import bpy
from mathutils import Vector

from ...backend.contract.result import Result
from .ownership import find_object, mark, owned_name

VOLUME_BOUNCES = 4  # fewer make lit smoke dark

# Light that makes a plume of albedo 0.95, lit (Relight 1), about as bright as it was filmed; found by rendering one.
_SUN_PER_RADIANCE = 9.0  # W/m^2
_AMBIENT_PER_RADIANCE = 0.7


def ensure(scene: bpy.types.Scene, collection: bpy.types.Collection, job: Path, result: Result) -> None:
    """A World, without which Blender 5 draws no smoke, and a sun for relighting. What is there already stays."""
    ensure_world(scene, ambient=_AMBIENT_PER_RADIANCE * max(*result.smoke_color, 0.05))
    if find_object(job, "sun") is not None:
        return
    light = bpy.data.lights.new(owned_name(job, "Sun"), "SUN")
    light.energy = _SUN_PER_RADIANCE * max(*result.smoke_color, 0.05)
    light.angle = math.radians(2.0)
    sun = bpy.data.objects.new(light.name, light)
    low, high = (Vector(corner) for corner in result.bounds)
    sun.location = (low + high) / 2 + Vector((0.0, 0.0, (high - low).length or 1.0))
    sun.rotation_euler = (math.radians(40.0), 0.0, math.radians(-50.0))
    mark(sun, job, "sun")
    collection.objects.link(sun)


def ensure_world(scene: bpy.types.Scene, *, ambient: float = 0.0) -> None:
    """A grey world where there is none; black by default."""
    if scene.world is not None:
        return
    world = bpy.data.worlds.new("World")
    world.use_nodes = True
    background = world.node_tree.nodes.get("Background")
    if background is not None:
        background.inputs["Color"].default_value = (ambient, ambient, ambient, 1.0)
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
