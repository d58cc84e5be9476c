"""Sky light and sun: the same in every version of Blender, so no built-in sky model is used."""

from __future__ import annotations

import math

import bpy

from ..scenes import SUN_AZIMUTH, SUN_ELEVATION

_SUN_STRENGTH = 7.0  # W/m^2
_SUN_SIZE = 1.0  # degrees
_SKY_STRENGTH = 0.35
_SKY_SEEN = 0.8  # as the camera sees it: a sky exposed for itself, and shadows that stay dark
_SKY_MAP = 128  # px high


def add_light() -> None:
    """A warm sun, and a sky that pales towards the horizon with soft clouds in it."""
    lamp = bpy.data.lights.new("sun", "SUN")
    lamp.energy = _SUN_STRENGTH
    lamp.color = (1.0, 0.93, 0.82)
    lamp.angle = math.radians(_SUN_SIZE)
    item = bpy.data.objects.new("sun", lamp)
    # A sun shines along its -z: tilt from the zenith, then turn to its azimuth.
    item.rotation_euler = (0.0, math.radians(90.0 - SUN_ELEVATION), math.radians(SUN_AZIMUTH))
    bpy.context.scene.collection.objects.link(item)
    _add_sky()


def add_black_world() -> None:
    """Nothing around: Blender 5 draws no smoke in a scene without a world, and a new one is grey."""
    tree = _new_world("black")
    background = tree.nodes.new("ShaderNodeBackground")
    background.inputs["Color"].default_value = (0.0, 0.0, 0.0, 1.0)
    output = tree.nodes.new("ShaderNodeOutputWorld")
    tree.links.new(background.outputs[0], output.inputs["Surface"])


def _new_world(name: str) -> bpy.types.NodeTree:
    world = bpy.data.worlds.new(name)
    bpy.context.scene.world = world
    # The map by which Cycles draws directions to the sky: a soft sky needs no more, and 1024 costs 3 s an image.
    world.cycles.sampling_method, world.cycles.sample_map_resolution = "MANUAL", _SKY_MAP
    if bpy.app.version < (5, 0):
        world.use_nodes = True
    world.node_tree.nodes.clear()
    return world.node_tree


def _add_sky() -> None:
    tree = _new_world("sky")
    coordinates = tree.nodes.new("ShaderNodeTexCoord")
    split = tree.nodes.new("ShaderNodeSeparateXYZ")
    tree.links.new(coordinates.outputs["Generated"], split.inputs[0])
    ramp = tree.nodes.new("ShaderNodeValToRGB")
    elements = ramp.color_ramp.elements
    elements.new(0.25)
    stops = ((0.0, (0.66, 0.74, 0.82)), (0.22, (0.36, 0.54, 0.8)), (0.9, (0.12, 0.28, 0.62)))
    for element, (place, color) in zip(elements, stops, strict=True):
        element.position = place
        element.color = (*color, 1.0)
    tree.links.new(split.outputs["Z"], ramp.inputs[0])
    stretch = tree.nodes.new("ShaderNodeMapping")
    stretch.inputs["Scale"].default_value = (2.2, 2.2, 7.0)
    tree.links.new(coordinates.outputs["Generated"], stretch.inputs["Vector"])
    clouds = tree.nodes.new("ShaderNodeTexNoise")
    clouds.inputs["Scale"].default_value = 1.6
    clouds.inputs["Detail"].default_value = 7.0
    tree.links.new(stretch.outputs[0], clouds.inputs["Vector"])
    cover = tree.nodes.new("ShaderNodeMapRange")
    cover.inputs["From Min"].default_value = 0.5
    cover.inputs["From Max"].default_value = 0.75
    cover.inputs["To Max"].default_value = 0.8
    tree.links.new(clouds.outputs[0], cover.inputs["Value"])
    mix = tree.nodes.new("ShaderNodeMixRGB")
    mix.inputs[2].default_value = (0.85, 0.86, 0.88, 1.0)
    tree.links.new(cover.outputs[0], mix.inputs[0])
    tree.links.new(ramp.outputs[0], mix.inputs[1])
    background = tree.nodes.new("ShaderNodeBackground")
    path = tree.nodes.new("ShaderNodeLightPath")
    strength = tree.nodes.new("ShaderNodeMath")
    strength.operation = "MULTIPLY_ADD"
    strength.inputs[1].default_value = _SKY_SEEN - _SKY_STRENGTH
    strength.inputs[2].default_value = _SKY_STRENGTH
    tree.links.new(path.outputs["Is Camera Ray"], strength.inputs[0])
    tree.links.new(strength.outputs[0], background.inputs["Strength"])
    tree.links.new(mix.outputs[0], background.inputs["Color"])
    output = tree.nodes.new("ShaderNodeOutputWorld")
    tree.links.new(background.outputs[0], output.inputs["Surface"])
