"""Runs inside Blender for test_cycles_images.py: small bright balls at known places, then smoke.

probe_scene.py FOLDER SMOKE_VDB
"""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import bpy

from backend.contract.cameras import read_cameras
from synthetic.layers import Layer, Quality
from synthetic.scene import cycles, meshes, shading
from synthetic.scene.camera import set_camera
from synthetic.scene.cycles import render_image, set_quality
from synthetic.scene.light import add_black_world
from synthetic.scene.smoke import show_smoke, smoke_window


def main(folder: Path, smoke: Path) -> None:
    balls = json.loads((folder / "balls.json").read_text())
    cameras = read_cameras(folder / "cameras.json")
    bpy.ops.wm.read_factory_settings(use_empty=True)
    add_black_world()
    material = shading.plain("ball", (1.0, 1.0, 1.0))
    shader = next(node for node in material.node_tree.nodes if node.type == "BSDF_PRINCIPLED")
    shader.inputs["Emission Color"].default_value = (1.0, 1.0, 1.0, 1.0)
    shader.inputs["Emission Strength"].default_value = 0.8
    set_quality(Quality(samples=32, is_denoised=False, bounces=0, volume_bounces=0), seed=1)
    for index, (position, radius) in enumerate(balls):
        ball = meshes.place(meshes.drum("ball", sphere_rings(radius, 12), material, sides=24), tuple(position))
        set_camera(cameras, index % len(cameras.camera_to_world))
        render_image(folder / f"ball_{index}.png", Layer.PLATE)
        render_image(folder / f"ball_{index}.exr", Layer.DEPTH)
        bpy.data.objects.remove(ball)
    show_smoke(smoke, albedo=(0.9, 0.9, 0.9))
    for index in range(len(cameras.camera_to_world)):
        set_camera(cameras, index)
        render_image(folder / f"smoke_{index}.png", Layer.SMOKE)
        cycles.smoke_window = lambda camera: ((0.0, 0.0), (1.0, 1.0))
        render_image(folder / f"whole_{index}.png", Layer.SMOKE)
        cycles.smoke_window = smoke_window


def sphere_rings(radius: float, count: int) -> list[tuple[float, float]]:
    angles = [math.pi * (step / count - 0.5) for step in range(count + 1)]
    return [(max(radius * math.cos(angle), 1e-4), radius * math.sin(angle)) for angle in angles]


main(Path(sys.argv[1]), Path(sys.argv[2]))
