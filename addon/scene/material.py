"""The smoke's material. Extinction equals the grid's, in 1/m, whatever the look.

Per metre, with extinction s = Density * grid, r = Relight, S the smoke's radiance as filmed, a its albedo:

    absorption = s (1 - r a)      scattering = s r a      emission = s (1 - r) S

At r = 0 a ray gathers B exp(-tau) + S (1 - exp(-tau)): the clip's own picture, needing no light. At r = 1 the smoke
is lit by the scene.
"""

from __future__ import annotations

import bpy

from ...backend.contract.result import Result

GROUP_NAME = "Wildsmoke Smoke"
GROUP_VERSION = 1
FAINT_HUE = 0.3  # difference of the channels, share of the brightest
DEFAULT_ALBEDO = 0.95  # of the brightest channel: fresh smoke scatters far more than it absorbs

_INPUTS = (  # name, socket type, default, minimum, maximum, what the artist reads
    ("Relight", "NodeSocketFloat", 0.0, 0.0, 1.0, "0: as filmed, needs no light. 1: lit by the scene"),
    ("Density", "NodeSocketFloat", 1.0, 0.0, 1000.0, "Multiplies the extinction of the asset"),
    ("Brightness", "NodeSocketFloat", 1.0, 0.0, 1000.0, "Multiplies the filmed radiance"),
    ("Filmed Color", "NodeSocketColor", (1.0, 1.0, 1.0, 1.0), None, None, "Linear radiance as filmed"),
    ("Albedo", "NodeSocketColor", (0.95, 0.95, 0.95, 1.0), None, None, "Share of the light that is scattered on"),
    ("Anisotropy", "NodeSocketFloat", 0.3, -0.99, 0.99, "Above 0: light goes on forwards, as in smoke"),
)


def apply(smoke: bpy.types.Object, result: Result, *, name: str) -> bpy.types.Material:
    """Give the volume its material. One that is there already is refreshed; what the artist set in it stays."""
    slots = smoke.data.materials
    found = slots[0] if slots and slots[0] is not None else None
    if found is not None:
        _connect_color(found, result)
        return found
    made = bpy.data.materials.new(name)
    made.use_nodes = True
    made.node_tree.nodes.clear()
    node = made.node_tree.nodes.new("ShaderNodeGroup")
    node.node_tree = smoke_group()
    node.name = node.label = GROUP_NAME
    node.width = 220
    if result.light is not None and result.light.anisotropy > 0.0:  # 0: the clip does not tell
        node.inputs["Anisotropy"].default_value = result.light.anisotropy
    output = made.node_tree.nodes.new("ShaderNodeOutputMaterial")
    output.location = (300, 0)
    made.node_tree.links.new(node.outputs["Volume"], output.inputs["Volume"])
    _connect_color(made, result)
    slots.clear()
    slots.append(made)
    return made


def hue_of(result: Result) -> tuple[float, float, float]:
    """The smoke's own hue, its brightest channel 1. Where the clip's light is known, a faint hue is the light's: smoke is grey
    unless it says otherwise."""
    low, brightest = min(result.smoke_color), max(result.smoke_color)
    if not brightest > 1e-6 or (result.light is not None and brightest - low < FAINT_HUE * brightest):
        return (1.0, 1.0, 1.0)
    r, g, b = (max(channel, 0.0) / brightest for channel in result.smoke_color)
    return (r, g, b)


def albedo_of(result: Result) -> tuple[float, float, float, float]:
    """The smoke's hue, its brightest channel at DEFAULT_ALBEDO: brightness is the light's part."""
    r, g, b = hue_of(result)
    return (DEFAULT_ALBEDO * r, DEFAULT_ALBEDO * g, DEFAULT_ALBEDO * b, 1.0)


def _connect_color(target: bpy.types.Material, result: Result) -> None:
    """Filmed colour from the `color` grid where there is one, else the smoke's one colour."""
    tree = target.node_tree
    node = tree.nodes.get(GROUP_NAME)
    if node is None:
        return  # the artist has built another material: theirs to keep
    attribute = tree.nodes.get("Color Grid")
    node.inputs["Filmed Color"].default_value = (*result.smoke_color, 1.0)
    node.inputs["Albedo"].default_value = albedo_of(result)
    if result.has_color and attribute is None:
        attribute = tree.nodes.new("ShaderNodeAttribute")
        attribute.name = attribute.label = "Color Grid"
        attribute.attribute_name = "color"
        attribute.location = (-260, 0)
        tree.links.new(attribute.outputs["Vector"], node.inputs["Filmed Color"])
    elif not result.has_color and attribute is not None:
        tree.nodes.remove(attribute)


def smoke_group() -> bpy.types.NodeTree:
    """The node group that all smoke materials share; made once a file."""
    found = bpy.data.node_groups.get(GROUP_NAME)
    if found is not None and found.get("wildsmoke_version") == GROUP_VERSION:
        return found
    group = bpy.data.node_groups.new(GROUP_NAME, "ShaderNodeTree")
    group["wildsmoke_version"] = GROUP_VERSION
    for name, kind, default, low, high, description in _INPUTS:
        socket = group.interface.new_socket(name, in_out="INPUT", socket_type=kind)
        socket.default_value, socket.description = default, description
        if low is not None:
            socket.min_value, socket.max_value = low, high
    group.interface.new_socket("Volume", in_out="OUTPUT", socket_type="NodeSocketShader")
    _fill_group(group)
    return group


def _fill_group(group: bpy.types.NodeTree) -> None:
    """The formulas of the module's docstring as nodes."""
    nodes, links = group.nodes, group.links
    given = nodes.new("NodeGroupInput")
    given.location = (-900, 0)
    grid = nodes.new("ShaderNodeAttribute")
    grid.attribute_name, grid.label = "density", "Extinction 1/m"
    grid.location = (-900, 300)

    def vector_math(
        operation: str, a: bpy.types.NodeSocket | tuple, b: bpy.types.NodeSocket | tuple, label: str
    ) -> bpy.types.NodeSocket:
        node = nodes.new("ShaderNodeVectorMath")
        node.operation, node.label = operation, label
        node.location = (-650 + 130 * (len(nodes) - 3), 300 - 150 * (len(nodes) % 3))
        for place, value in enumerate((a, b)):
            if isinstance(value, tuple):
                node.inputs[place].default_value = value
            else:
                links.new(value, node.inputs[place])
        return node.outputs["Vector"]

    extinction = vector_math("MULTIPLY", grid.outputs["Fac"], given.outputs["Density"], "s")
    relit = vector_math("MULTIPLY", given.outputs["Albedo"], given.outputs["Relight"], "r a")
    scattering = vector_math("MULTIPLY", extinction, relit, "s r a")
    absorption = vector_math("SUBTRACT", extinction, scattering, "s (1 - r a)")
    filmed = vector_math("SUBTRACT", (1.0, 1.0, 1.0), given.outputs["Relight"], "1 - r")
    radiance = vector_math("MULTIPLY", given.outputs["Filmed Color"], given.outputs["Brightness"], "S")
    source = vector_math("MULTIPLY", radiance, filmed, "(1 - r) S")
    emission = vector_math("MULTIPLY", extinction, source, "s (1 - r) S")
    medium = nodes.new("ShaderNodeVolumeCoefficients")
    medium.location = (600, 0)
    links.new(absorption, medium.inputs["Absorption Coefficients"])
    links.new(scattering, medium.inputs["Scatter Coefficients"])
    links.new(emission, medium.inputs["Emission Coefficients"])
    links.new(given.outputs["Anisotropy"], medium.inputs["Anisotropy"])
    result = nodes.new("NodeGroupOutput")
    result.location = (850, 0)
    links.new(medium.outputs["Volume"], result.inputs["Volume"])
