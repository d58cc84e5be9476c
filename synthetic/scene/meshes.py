"""Plain meshes by hand, without operators: boxes, prisms, drums, cones, terrain. Lengths in m, UV 1 unit = 1 m."""

from __future__ import annotations

import math
from collections.abc import Sequence

import bpy

Point = tuple[float, float, float]


def add_mesh(
    name: str,
    points: Sequence[Point],
    faces: Sequence[Sequence[int]],
    material: bpy.types.Material,
    *,
    is_smooth: bool = False,
) -> bpy.types.Object:
    """A mesh object in the scene. Its UV map unrolls each face along the horizontal and the other axis of its plane."""
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(points, [], faces)
    mesh.materials.append(material)
    mesh.update()
    layer = mesh.uv_layers.new(name="UVMap")
    for polygon in mesh.polygons:
        polygon.use_smooth = is_smooth
        nx, ny, nz = polygon.normal
        for loop in polygon.loop_indices:
            x, y, z = mesh.vertices[mesh.loops[loop].vertex_index].co
            if abs(nz) > 0.8:
                layer.data[loop].uv = (x, y)
            elif abs(nx) > abs(ny):
                layer.data[loop].uv = (y, z)
            else:
                layer.data[loop].uv = (x, z)
    result = bpy.data.objects.new(name, mesh)
    bpy.context.scene.collection.objects.link(result)
    return result


def place(item: bpy.types.Object, position: Point, *, turn: float = 0.0) -> bpy.types.Object:
    """Move an object, turned about the vertical by `turn` radians."""
    item.location = position
    item.rotation_euler = (0.0, 0.0, turn)
    return item


def box(name: str, size: Point, material: bpy.types.Material) -> bpy.types.Object:
    """A box that stands on its origin."""
    a, b, c = size[0] / 2, size[1] / 2, size[2]
    points = [(x, y, z) for z in (0.0, c) for y in (-b, b) for x in (-a, a)]
    faces = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
    return add_mesh(name, points, faces, material)


def gable(name: str, size: Point, material: bpy.types.Material) -> bpy.types.Object:
    """A roof: a triangular prism whose ridge runs along x, standing on its origin."""
    a, b, c = size[0] / 2, size[1] / 2, size[2]
    points = [(-a, -b, 0.0), (a, -b, 0.0), (a, b, 0.0), (-a, b, 0.0), (-a, 0.0, c), (a, 0.0, c)]
    return add_mesh(name, points, [(0, 1, 5, 4), (2, 3, 4, 5), (0, 4, 3), (1, 2, 5), (0, 3, 2, 1)], material)


def drum(name: str, rings: Sequence[tuple[float, float]], material: bpy.types.Material, *, sides: int = 32) -> bpy.types.Object:
    """A surface of revolution through rings of (radius, height), bottom to top, open where the last radius is not 0."""
    points: list[Point] = []
    for radius, height in rings:
        for side in range(sides):
            angle = 2 * math.pi * side / sides
            points.append((radius * math.cos(angle), radius * math.sin(angle), height))
    faces = []
    for ring in range(len(rings) - 1):
        for side in range(sides):
            following = (side + 1) % sides
            a, b = ring * sides, (ring + 1) * sides
            faces.append((a + side, a + following, b + following, b + side))
    item = add_mesh(name, points, faces, material, is_smooth=True)
    around = 2 * math.pi * max(radius for radius, _ in rings)
    layer = item.data.uv_layers[0]
    for polygon in item.data.polygons:  # u once around, without a jump in the last face
        side = polygon.index % sides
        for loop, step in zip(polygon.loop_indices, (0, 1, 1, 0), strict=True):
            height = item.data.vertices[item.data.loops[loop].vertex_index].co.z
            layer.data[loop].uv = ((side + step) * around / sides, height)
    return item
