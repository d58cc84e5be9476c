"""The static scene: a works yard with a chimney, buildings and trees in open country, hills behind. Seeded, procedural.

All around the chimney there is something at several depths, because views are taken from all sides.
"""

from __future__ import annotations

import math

import bpy
import numpy as np

from synthetic.scene import meshes, shading
from synthetic.scenes import CHIMNEY_TOP, SmokeScene

_YARD_RADIUS = 20.0  # m; flat inside
_LAND_RADIUS = 420.0  # m


def build_landscape(scene: SmokeScene, *, seed: int = 7) -> None:
    """Everything but smoke, light and camera."""
    random = np.random.Generator(np.random.PCG64(seed))
    _add_ground(random)
    _add_hearths(scene)
    _add_buildings()
    _add_clutter(random)
    _add_trees(random)
    _add_obstacles(scene)


def _add_ground(random: np.random.Generator) -> None:
    """Terrain as a polar mesh: fine and flat in the yard, hills far away."""
    material = shading.patchwork("ground", ((0.075, 0.055, 0.03), (0.13, 0.11, 0.05), (0.09, 0.11, 0.035)), scale=0.16)
    radii = np.concatenate([[0.0], np.geomspace(4.0, _LAND_RADIUS, 56)])
    sides = 180
    angles = 2 * np.pi * np.arange(sides) / sides
    waves = random.uniform(0, 2 * np.pi, size=12)
    points: list[meshes.Point] = []
    for radius in radii:
        far = np.clip((radius - 45.0) / 250.0, 0, 1)
        near = np.clip((radius - _YARD_RADIUS) / 25.0, 0, 1)
        for angle in angles:
            x, y = radius * math.cos(angle), radius * math.sin(angle)
            ridge = sum(math.cos((k + 2) * angle + waves[k]) / (k + 2) ** 0.7 for k in range(12))
            rolling = math.sin(0.09 * x + 1.0) * math.cos(0.07 * y)
            points.append((x, y, float(far * far * (34.0 + 11.0 * ridge) + near * 0.5 * rolling)))
    faces = []
    for ring in range(len(radii) - 1):
        for side in range(sides):
            following = (side + 1) % sides
            a, b = ring * sides, (ring + 1) * sides
            faces.append((a + side, b + side, b + following, a + following))
    meshes.add_mesh("ground", points, faces, material, is_smooth=True)


def _add_hearths(scene: SmokeScene) -> None:
    """What the smoke comes from: a brick chimney where the source is high enough, else a ring of stones."""
    brick = shading.bricks("chimney", (0.24, 0.075, 0.04), (0.17, 0.05, 0.03), (0.2, 0.18, 0.15), scale=2.2)
    soot = shading.plain("soot", (0.012, 0.012, 0.012), roughness=1.0)
    for source in scene.sources:
        x, y, z = source.position
        outer = source.radius + 0.25
        rings = [(outer + 0.25, 0.0), (outer, 0.6 * z), (outer, z - 0.25), (outer + 0.12, z - 0.25), (outer + 0.12, z)]
        if z < 0.5 * CHIMNEY_TOP:
            rings = [(outer + 0.2, 0.0), (outer, max(z, 0.3))]
        rim, top = rings[-1]
        meshes.place(meshes.drum("chimney", rings, brick), (x, y, 0.0))
        meshes.place(meshes.drum("chimney rim", [(rim, top), (source.radius, top)], brick), (x, y, 0.0))
        flue = [(source.radius, top), (source.radius, max(0.05, top - 1.0)), (0.01, max(0.05, top - 1.0))]
        meshes.place(meshes.drum("flue", flue, soot), (x, y, 0.0))


def _add_buildings() -> None:
    wall = shading.bricks("wall", (0.4, 0.25, 0.16), (0.3, 0.17, 0.1), (0.42, 0.4, 0.36), scale=1.6)
    plaster = shading.speckled("plaster", (0.33, 0.3, 0.24), (0.52, 0.48, 0.4), scale=1.1, bump=0.1)
    tiles = shading.bricks("tiles", (0.22, 0.09, 0.055), (0.13, 0.06, 0.045), (0.05, 0.03, 0.03), scale=2.4)
    sheet = shading.corrugated("sheet", (0.28, 0.33, 0.35), scale=3.0)
    glass = shading.plain("glass", (0.02, 0.03, 0.045), roughness=0.12)
    steel = shading.speckled("steel", (0.25, 0.26, 0.27), (0.42, 0.42, 0.4), scale=0.9, roughness=0.5, bump=0.05)
    houses = (  # x, y, turn, length, depth, height, wall, roof
        (-7.0, 8.5, 0.25, 9.0, 5.0, 3.4, wall, tiles),
        (9.0, 12.5, -0.35, 12.0, 6.0, 4.2, plaster, sheet),
        (-12.5, -7.0, 1.25, 7.5, 4.5, 3.0, plaster, tiles),
        (13.5, -5.5, 1.8, 8.0, 5.0, 3.2, wall, sheet),
        (1.0, 24.0, 0.05, 15.0, 6.5, 5.0, wall, tiles),
        (-24.0, 16.0, 0.7, 12.0, 6.0, 4.5, plaster, tiles),
        (2.5, -21.0, -0.15, 7.0, 4.0, 2.6, wall, tiles),
    )
    for x, y, turn, length, depth, height, walls, roof in houses:
        meshes.place(meshes.box("house", (length, depth, height), walls), (x, y, 0.0), turn=turn)
        meshes.place(meshes.gable("roof", (length + 0.6, depth + 0.9, 0.38 * depth), roof), (x, y, height), turn=turn)
        count = int(length // 2.2)
        for index in range(count):
            for side in (-1, 1):
                along, across = (index - 0.5 * (count - 1)) * 2.1, side * (0.5 * depth + 0.01)
                wx = x + along * math.cos(turn) - across * math.sin(turn)
                wy = y + along * math.sin(turn) + across * math.cos(turn)
                meshes.place(meshes.box("window", (1.0, 0.1, 1.2), glass), (wx, wy, 0.42 * height), turn=turn)
    for x, y, radius, height in ((5.2, 5.4, 1.25, 3.6), (7.9, 6.6, 1.25, 3.0), (-10.5, 3.5, 1.0, 4.4), (6.0, -11.0, 1.1, 2.6)):
        rings = [(radius, 0.0), (radius, height), (0.5 * radius, height + 0.4), (0.01, height + 0.5)]
        meshes.place(meshes.drum("tank", rings, steel), (x, y, 0.0))
    _add_mast(steel)


def _add_mast(material: bpy.types.Material) -> None:
    """A lattice mast: thin lines in front of which smoke drifts."""
    x, y, height, base = -4.6, 6.0, 9.0, 0.55
    for sx, sy in ((-1, -1), (1, -1), (1, 1), (-1, 1)):
        meshes.place(meshes.box("mast", (0.09, 0.09, height), material), (x + sx * base, y + sy * base, 0.0))
    along_x, along_y = (1.1, 0.05, 0.05), (0.05, 1.1, 0.05)
    for level in np.arange(0.8, height, 0.8):
        for sx, sy, size in ((0, -1, along_x), (0, 1, along_x), (-1, 0, along_y), (1, 0, along_y)):
            meshes.place(meshes.box("brace", size, material), (x + sx * base, y + sy * base, float(level)))


def _add_clutter(random: np.random.Generator) -> None:
    """Crates, boulders and fence posts scattered over the yard, none on the hearths or inside the first walls."""
    timber = shading.speckled("timber", (0.17, 0.1, 0.045), (0.33, 0.22, 0.11), scale=3.0, bump=0.2)
    stone = shading.speckled("stone", (0.12, 0.115, 0.105), (0.3, 0.29, 0.26), scale=2.2, bump=0.6)
    for _ in range(34):
        radius, angle = random.uniform(3.6, 17.0), random.uniform(0, 2 * np.pi)
        size = random.uniform(0.4, 1.1, size=3)
        item = meshes.box("crate", (float(size[0]), float(size[1]), float(size[2])), timber)
        meshes.place(item, (radius * math.cos(angle), radius * math.sin(angle), 0.0), turn=float(random.uniform(0, 3)))
    for _ in range(46):
        radius, angle, size = random.uniform(4.0, 30.0), random.uniform(0, 2 * np.pi), random.uniform(0.15, 0.7)
        profile = ((1, 0), (0.95, 0.35), (0.6, 0.7), (0.02, 0.85))
        lumps = [(size * (1 + 0.25 * random.uniform(-1, 1)) * r, size * h) for r, h in profile]
        item = meshes.drum("boulder", [(float(r), float(h)) for r, h in lumps], stone, sides=9)
        meshes.place(item, (radius * math.cos(angle), radius * math.sin(angle), -0.05), turn=float(random.uniform(0, 3)))
    for index in range(84):
        angle = 2 * np.pi * index / 84
        meshes.place(meshes.box("post", (0.12, 0.12, 1.2), timber), (19.0 * math.cos(angle), 19.0 * math.sin(angle), 0.0))


def _add_trees(random: np.random.Generator) -> None:
    """Conifers from the yard's edge to the hills: two meshes, many objects that share them."""
    bark = shading.speckled("bark", (0.06, 0.035, 0.02), (0.13, 0.08, 0.05), scale=4.0)
    needles = shading.speckled("needles", (0.012, 0.03, 0.012), (0.045, 0.085, 0.03), scale=2.6, bump=1.0)
    crowns = []
    for variant in range(3):
        rings: list[tuple[float, float]] = []
        for level in range(7):
            width = (1.0 - level / 7.5) * (1.0 + 0.1 * variant)
            rings += [(0.85 * width, 0.22 + 0.11 * level), (0.42 * width, 0.31 + 0.11 * level)]
        rings.append((0.01, 1.05))
        crowns.append(meshes.drum(f"crown {variant}", [(0.24 * r, h) for r, h in rings], needles, sides=11))
    trunk = meshes.drum("trunk", [(0.035, 0.0), (0.02, 0.4)], bark, sides=7)
    patterns = [*crowns, trunk]
    for _ in range(420):
        radius = float(21.0 + 150.0 * random.uniform(0, 1) ** 1.6)
        angle, height = random.uniform(0, 2 * np.pi), float(random.uniform(4.0, 9.5))
        x, y = radius * math.cos(angle), radius * math.sin(angle)
        far = np.clip((radius - 45.0) / 250.0, 0, 1)
        for pattern in (crowns[int(random.integers(3))], trunk):
            item = bpy.data.objects.new(pattern.name, pattern.data)
            bpy.context.scene.collection.objects.link(item)
            meshes.place(item, (x, y, float(far * far * 26.0) - 0.4), turn=float(random.uniform(0, 6)))
            item.scale = (height, height, height)
    for pattern in patterns:
        bpy.data.objects.remove(pattern)


def _add_obstacles(scene: SmokeScene) -> None:
    """The boxes that the solver's smoke flows around."""
    concrete = shading.speckled("concrete", (0.27, 0.26, 0.24), (0.45, 0.44, 0.41), scale=0.8, bump=0.15)
    for obstacle in scene.obstacles:
        size = tuple(b - a for a, b in zip(obstacle.low, obstacle.high, strict=True))
        middle = (0.5 * (obstacle.low[0] + obstacle.high[0]), 0.5 * (obstacle.low[1] + obstacle.high[1]), obstacle.low[2])
        meshes.place(meshes.box("obstacle", size, concrete), middle)  # type: ignore[arg-type]
        for x in (obstacle.low[0] + 0.1, obstacle.high[0] - 0.1):  # too thin for the solver's cells, so only seen
            for y in (obstacle.low[1] + 0.1, obstacle.high[1] - 0.1):
                meshes.place(meshes.box("leg", (0.14, 0.14, obstacle.low[2]), concrete), (x, y, 0.0))
