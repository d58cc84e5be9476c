"""Procedural materials. Node sockets are addressed by place where their names differ between Blender 4.5 and 5.2.

Only what the camera sees has texture and relief; light that bounces meets the mean colour. Without that, evaluating noise
at every bounce takes two thirds of the time of an image and shows nowhere.
"""

from __future__ import annotations

import bpy

Color = tuple[float, float, float]  # linear RGB

_SWITCH = "textured to the camera"


def show_texture(is_shown: bool) -> None:
    """Whether the camera sees texture, or mean colours everywhere: cheaper where things only hide and light the smoke."""
    if _SWITCH in bpy.data.node_groups:
        value = bpy.data.node_groups[_SWITCH].nodes["is shown"].inputs[1]
        if value.default_value != float(is_shown):  # to set is to compile all materials anew
            value.default_value = float(is_shown)


def speckled(
    name: str, dark: Color, light: Color, *, scale: float, roughness: float = 0.9, bump: float = 0.3, detail: float = 5.0
) -> bpy.types.Material:
    """Two colours mixed by fractal noise in object space (scale in 1/m), with the same noise as relief."""
    material, tree, shader = _new_textured(name, roughness, mean=_mean(dark, light))
    noise = tree.nodes.new("ShaderNodeTexNoise")
    noise.inputs["Scale"].default_value = scale
    noise.inputs["Detail"].default_value = detail
    noise.inputs["Roughness"].default_value = 0.7
    _link_position(tree, noise)
    ramp = _ramp(tree, noise.outputs[0], ((0.35, dark), (0.68, light)))
    tree.links.new(ramp, shader.inputs["Base Color"])
    _add_bump(tree, shader, noise.outputs[0], bump)
    return material


def patchwork(name: str, colors: tuple[Color, Color, Color], *, scale: float) -> bpy.types.Material:
    """Ground: large patches of three colours under fine speckles, so that every window of the image has texture."""
    material, tree, shader = _new_textured(name, 1.0, mean=_mean(*colors))
    large = tree.nodes.new("ShaderNodeTexNoise")
    large.inputs["Scale"].default_value = scale
    large.inputs["Detail"].default_value = 3.0
    fine = tree.nodes.new("ShaderNodeTexNoise")
    fine.inputs["Scale"].default_value = 14 * scale
    fine.inputs["Detail"].default_value = 6.0
    fine.inputs["Roughness"].default_value = 0.75
    for node in (large, fine):
        _link_position(tree, node)
    blend = tree.nodes.new("ShaderNodeMath")
    blend.operation = "MULTIPLY_ADD"
    blend.inputs[1].default_value = 0.55
    tree.links.new(fine.outputs[0], blend.inputs[0])
    half = tree.nodes.new("ShaderNodeMath")
    half.operation = "MULTIPLY"
    half.inputs[1].default_value = 0.45
    tree.links.new(large.outputs[0], half.inputs[0])
    tree.links.new(half.outputs[0], blend.inputs[2])
    ramp = _ramp(tree, blend.outputs[0], ((0.4, colors[0]), (0.5, colors[1]), (0.6, colors[2])))
    tree.links.new(ramp, shader.inputs["Base Color"])
    _add_bump(tree, shader, fine.outputs[0], 0.4)
    return material


def bricks(name: str, first: Color, second: Color, mortar: Color, *, scale: float) -> bpy.types.Material:
    """Brick courses laid along the mesh's UV map (1 unit = 1 m)."""
    material, tree, shader = _new_textured(name, 0.9, mean=_mean(first, second))
    brick = tree.nodes.new("ShaderNodeTexBrick")
    for socket, color in zip(("Color1", "Color2", "Mortar"), (first, second, mortar), strict=True):
        brick.inputs[socket].default_value = (*color, 1.0)
    brick.inputs["Scale"].default_value = scale
    brick.inputs["Mortar Size"].default_value = 0.03
    coordinates = tree.nodes.new("ShaderNodeTexCoord")
    tree.links.new(coordinates.outputs["UV"], brick.inputs["Vector"])
    tree.links.new(brick.outputs["Color"], shader.inputs["Base Color"])
    return material


def corrugated(name: str, color: Color, *, scale: float) -> bpy.types.Material:
    """Ribbed sheet along the UV map's first axis, streaked with rust."""
    rust = (0.16, 0.07, 0.035)
    material, tree, shader = _new_textured(name, 0.6, mean=_mean(color, rust))
    coordinates = tree.nodes.new("ShaderNodeTexCoord")
    wave = tree.nodes.new("ShaderNodeTexWave")
    wave.inputs["Scale"].default_value = scale
    tree.links.new(coordinates.outputs["UV"], wave.inputs["Vector"])
    noise = tree.nodes.new("ShaderNodeTexNoise")
    noise.inputs["Scale"].default_value = 1.3
    noise.inputs["Detail"].default_value = 5.0
    tree.links.new(coordinates.outputs["UV"], noise.inputs["Vector"])
    ramp = _ramp(tree, noise.outputs[0], ((0.46, color), (0.66, rust)))
    tree.links.new(ramp, shader.inputs["Base Color"])
    _add_bump(tree, shader, wave.outputs[1], 0.8)
    return material


def plain(name: str, color: Color, *, roughness: float = 0.5) -> bpy.types.Material:
    """One colour."""
    material, _, shader = _new(name, roughness)
    shader.inputs["Base Color"].default_value = (*color, 1.0)
    return material


def smoke(name: str, albedo: Color, *, anisotropy: float) -> bpy.types.Material:
    """Scattering smoke whose extinction is the grid `density` itself, 1/m: scattering albedo x density, the rest absorbed."""
    material = bpy.data.materials.new(name)
    if bpy.app.version < (5, 0):
        material.use_nodes = True
    tree = material.node_tree
    tree.nodes.clear()
    volume = tree.nodes.new("ShaderNodeVolumePrincipled")
    volume.inputs["Color"].default_value = (*albedo, 1.0)
    volume.inputs["Density"].default_value = 1.0
    volume.inputs["Density Attribute"].default_value = "density"
    volume.inputs["Absorption Color"].default_value = (0.0, 0.0, 0.0, 1.0)
    volume.inputs["Anisotropy"].default_value = anisotropy
    volume.inputs["Temperature Attribute"].default_value = ""
    output = tree.nodes.new("ShaderNodeOutputMaterial")
    tree.links.new(volume.outputs[0], output.inputs["Volume"])
    return material


def depth(name: str) -> bpy.types.Material:
    """Shines with the distance along the camera's axis, m."""
    material, tree, shader = _new(name, 1.0)
    tree.nodes.remove(shader)
    camera = tree.nodes.new("ShaderNodeCameraData")
    emission = tree.nodes.new("ShaderNodeEmission")
    tree.links.new(camera.outputs["View Z Depth"], emission.inputs["Color"])
    output = next(node for node in tree.nodes if node.type == "OUTPUT_MATERIAL")
    tree.links.new(emission.outputs[0], output.inputs["Surface"])
    return material


def absorption(name: str) -> bpy.types.Material:
    """Black smoke: absorbs with the grid `density`, 1/m, and scatters nothing."""
    material, tree, shader = _new(name, 1.0)
    tree.nodes.remove(shader)
    density = tree.nodes.new("ShaderNodeAttribute")
    density.attribute_name = "density"
    volume = tree.nodes.new("ShaderNodeVolumeAbsorption")
    volume.inputs["Color"].default_value = (0.0, 0.0, 0.0, 1.0)
    tree.links.new(density.outputs["Fac"], volume.inputs["Density"])
    output = next(node for node in tree.nodes if node.type == "OUTPUT_MATERIAL")
    tree.links.new(volume.outputs[0], output.inputs["Volume"])
    return material


def _new(name: str, roughness: float) -> tuple[bpy.types.Material, bpy.types.NodeTree, bpy.types.Node]:
    material = bpy.data.materials.new(name)
    if bpy.app.version < (5, 0):
        material.use_nodes = True
    tree = material.node_tree
    tree.nodes.clear()
    shader = tree.nodes.new("ShaderNodeBsdfPrincipled")
    shader.inputs["Roughness"].default_value = roughness
    output = tree.nodes.new("ShaderNodeOutputMaterial")
    tree.links.new(shader.outputs[0], output.inputs["Surface"])
    return material, tree, shader


def _new_textured(name: str, roughness: float, *, mean: Color) -> tuple[bpy.types.Material, bpy.types.NodeTree, bpy.types.Node]:
    """A material whose shader the camera sees; every other ray meets a matt surface of the mean colour. Cycles skips the
    side of a mix that has no weight."""
    material, tree, shader = _new(name, roughness)
    matt = tree.nodes.new("ShaderNodeBsdfDiffuse")
    matt.inputs["Color"].default_value = (*mean, 1.0)
    switch = tree.nodes.new("ShaderNodeGroup")
    switch.node_tree = bpy.data.node_groups.get(_SWITCH) or _new_switch()
    mix = tree.nodes.new("ShaderNodeMixShader")
    output = next(node for node in tree.nodes if node.type == "OUTPUT_MATERIAL")
    tree.links.new(switch.outputs[0], mix.inputs[0])
    tree.links.new(matt.outputs[0], mix.inputs[1])
    tree.links.new(shader.outputs[0], mix.inputs[2])
    tree.links.new(mix.outputs[0], output.inputs["Surface"])
    return material, tree, shader


def _new_switch() -> bpy.types.NodeTree:
    """1 for rays from the camera while texture is shown, else 0; shared by all materials."""
    tree = bpy.data.node_groups.new(_SWITCH, "ShaderNodeTree")
    tree.interface.new_socket("is shown", in_out="OUTPUT", socket_type="NodeSocketFloat")
    path = tree.nodes.new("ShaderNodeLightPath")
    product = tree.nodes.new("ShaderNodeMath")
    product.name, product.operation = "is shown", "MULTIPLY"
    product.inputs[1].default_value = 1.0
    result = tree.nodes.new("NodeGroupOutput")
    tree.links.new(path.outputs["Is Camera Ray"], product.inputs[0])
    tree.links.new(product.outputs[0], result.inputs[0])
    return tree


def _mean(*colors: Color) -> Color:
    red, green, blue = (sum(channel) / len(colors) for channel in zip(*colors, strict=True))
    return red, green, blue


def _link_position(tree: bpy.types.NodeTree, texture: bpy.types.Node) -> None:
    """Object coordinates: metres, and the same on every side of a thing."""
    coordinates = tree.nodes.new("ShaderNodeTexCoord")
    tree.links.new(coordinates.outputs["Object"], texture.inputs["Vector"])


def _ramp(tree: bpy.types.NodeTree, value: bpy.types.NodeSocket, stops: tuple[tuple[float, Color], ...]) -> bpy.types.NodeSocket:
    ramp = tree.nodes.new("ShaderNodeValToRGB")
    elements = ramp.color_ramp.elements
    while len(elements) < len(stops):
        elements.new(0.5)
    for element, (place, color) in zip(elements, stops, strict=True):
        element.position = place
        element.color = (*color, 1.0)
    tree.links.new(value, ramp.inputs[0])
    return ramp.outputs[0]


def _add_bump(tree: bpy.types.NodeTree, shader: bpy.types.Node, height: bpy.types.NodeSocket, strength: float) -> None:
    bump = tree.nodes.new("ShaderNodeBump")
    bump.inputs["Strength"].default_value = strength
    bump.inputs["Distance"].default_value = 0.1
    tree.links.new(height, bump.inputs["Height"])
    tree.links.new(bump.outputs[0], shader.inputs["Normal"])
