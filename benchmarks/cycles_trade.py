"""What an image of the benchmark costs in Cycles, and how far it is from a 2048-sample reference. Runs inside Blender:

    .venv/blender52/bin/python -m benchmarks.cycles_trade --smoke FILE.vdb --out DIR [--scene puff_front] [--frame 67]
    .venv/blender/bin/python   -m benchmarks.cycles_trade --smoke FILE.vdb --out DIR ...       (after the other)
    .venv/backend/bin/python   -m benchmarks.cycles_trade_figures DIR                          docs/results, plot

One setting is changed at a time. The reference, made by the newer Blender, is unbiased, not denoised, with 16 bounces and
another seed. Every case is kept in DIR as soon as it is done; a broken run goes on. Cheap cases come first.

Error: root mean square of the difference of sRGB-coded values, over the full frame and over the smoke (opacity above 2 %).
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

import bpy
import numpy as np

from synthetic.layers import Layer, Quality
from synthetic.presets import PRESETS, Preset
from synthetic.render import RenderOrder, build_scene
from synthetic.scene.camera import set_camera
from synthetic.scene.cycles import render_light, render_opacity, set_quality
from synthetic.scene.pixels import srgb
from synthetic.scene.smoke import show_smoke
from synthetic.scenes import SCENES
from synthetic.sweep import orbit_cameras

REFERENCE_SAMPLES = 2048
_REFERENCE = Quality(samples=REFERENCE_SAMPLES, is_denoised=False, is_biased=False, bounces=16, volume_bounces=16)
_SEED, _REFERENCE_SEED = 1, 2  # the same seed would make a short run the beginning of the long one
_SAMPLES = (4, 8, 16, 32, 64, 128, 256, 512)


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """One image. axis: what is changed; scale: of width and height; samples of the opacity where that is the layer."""

    axis: str
    layer: str  # "clip", "smoke" or "opacity"
    quality: Quality
    scale: float = 1.0

    @property
    def name(self) -> str:
        quality = self.quality
        bias = "biased" if quality.is_biased else "unbiased"
        noise = "denoised" if quality.is_denoised else "plain"
        numbers = f"s{quality.samples}-b{quality.bounces}-v{quality.volume_bounces}-r{quality.step_rate:g}-x{self.scale:g}"
        return f"{self.axis}-{self.layer}-{bias}-{noise}-{numbers}"


def cases(*, has_unbiased: bool) -> list[Case]:
    """All cases, cheap ones first."""
    biases = (True, False) if has_unbiased else (True,)
    found = [
        Case(axis="samples", layer=layer, quality=Quality(samples=samples, is_denoised=denoised, is_biased=biased))
        for layer in ("clip", "smoke")
        for denoised in (False, True)
        for biased in (biases if layer == "clip" else (True,))
        for samples in _SAMPLES[: (8 if biased else 7) if layer == "clip" else 5]
    ]
    base = Quality(samples=64)
    for bounces in (0, 1, 2, 4, 8, 16):
        found.append(Case(axis="bounces", layer="clip", quality=replace(base, bounces=bounces, volume_bounces=bounces)))
    for rate in (0.25, 0.5, 1.0, 2.0, 4.0, 8.0):
        found.append(Case(axis="step rate", layer="clip", quality=replace(base, step_rate=rate)))
    for layer in ("clip", "smoke"):
        for scale in (0.25, 0.5, 0.75, 1.0, 1.5, 2.0):
            found.append(Case(axis="resolution", layer=layer, quality=replace(base, samples=16), scale=scale))
    found += [Case(axis="samples", layer="opacity", quality=Quality(samples=samples)) for samples in (1, 2, 4, 8, 16, 32, 64)]
    return sorted(found, key=lambda case: case.quality.samples * case.scale**2 / min(1.0, case.quality.step_rate))


def main(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--smoke", type=Path, required=True, help="VDB of the frame")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--scene", default="puff_front")
    parser.add_argument("--frame", type=int, default=67)
    parser.add_argument("--most-samples", type=int, default=_SAMPLES[-1], help="leave dearer cases for another run")
    given = parser.parse_args(arguments)
    preset = PRESETS["bench"]
    order = RenderOrder(scene=given.scene, folder=given.out, preset=preset, preset_name="bench")
    given.out.mkdir(parents=True, exist_ok=True)
    build_scene(order)
    show_smoke(given.smoke.absolute(), albedo=SCENES[given.scene].albedo)
    references = _references(preset, given.frame, given.out)
    version = ".".join(map(str, bpy.app.version[:2]))
    for case in cases(has_unbiased=bpy.app.version >= (5, 0)):
        path = given.out / f"{version} {case.name}.json"
        if path.exists() or case.quality.samples > given.most_samples:
            continue
        image, wall, cpu = _render(case, preset, given.frame, seed=_SEED)
        figures = {"blender": bpy.app.version_string, "axis": case.axis, "layer": case.layer, "scale": case.scale}
        kept = ("samples", "is_denoised", "is_biased", "bounces", "volume_bounces", "step_rate")
        figures |= {key: getattr(case.quality, key) for key in kept}
        figures |= {"seconds": round(wall, 3), "cpu_seconds": round(cpu, 3), "busy": round(os.getloadavg()[0], 1)}
        figures |= errors(case, image, references)
        path.write_text(json.dumps(figures, indent=1), encoding="utf-8")
        print(f"{version} {case.name}: {cpu:.2f} s, {figures['smoke_error']:.4f}", file=sys.stderr, flush=True)
    return 0


def _references(preset: Preset, frame: int, folder: Path) -> dict[str, np.ndarray]:
    """The three reference images; made by Blender 5, read by both."""
    found = {}
    for layer, samples in (("opacity", 512), ("clip", REFERENCE_SAMPLES), ("smoke", REFERENCE_SAMPLES)):
        path = folder / f"reference-{layer}.npy"
        if not path.exists():
            if bpy.app.version < (5, 0):
                raise SystemExit(f"{path} is missing: run this with Blender 5 first, which can render without bias.")
            case = Case(axis="reference", layer=layer, quality=replace(_REFERENCE, samples=samples))
            image, _, cpu = _render(case, preset, frame, seed=_REFERENCE_SEED)
            print(f"reference {layer}: {cpu:.0f} s", file=sys.stderr, flush=True)
            with open(folder / "part.npy", "wb") as file:
                np.save(file, image)
            (folder / "part.npy").replace(path)
        found[layer] = np.load(path)
    return found


def _render(case: Case, preset: Preset, frame: int, *, seed: int) -> tuple[np.ndarray, float, float]:
    """The image [H, W, 4], linear; its wall-clock and processor seconds."""
    width, height = round(preset.width * case.scale), round(preset.height * case.scale)
    cameras = orbit_cameras(preset.orbit, width=width, height=height, fps=preset.fps, num_frames=preset.num_frames)
    set_camera(cameras, frame)
    set_quality(replace(case.quality, opacity_samples=case.quality.samples), seed=seed)
    begin = time.perf_counter(), time.process_time()
    if case.layer == "opacity":
        image = np.repeat(render_opacity()[..., None], 4, axis=2)
    else:
        image = render_light(Layer(case.layer))
    return image, time.perf_counter() - begin[0], time.process_time() - begin[1]


def errors(case: Case, image: np.ndarray, references: dict[str, np.ndarray]) -> dict[str, float]:
    """Root mean square error against the reference; another resolution is brought to its size first."""
    target = references[case.layer]
    if image.shape != target.shape:
        image = resized(image, target.shape[0], target.shape[1])
    if case.layer == "opacity":
        squares = np.square(image[..., 3:] - target[..., 3:], dtype=np.float64)
    else:
        squares = np.square(srgb(image[..., :3]) - srgb(target[..., :3]))
    is_smoke = references["opacity"][..., 3] > 0.02
    full, smoke = float(np.sqrt(squares.mean())), float(np.sqrt(squares[is_smoke].mean()))
    return {"full_error": round(full, 6), "smoke_error": round(smoke, 6)}


def resized(image: np.ndarray, height: int, width: int) -> np.ndarray:
    """Bilinear between pixel centres; a larger image is averaged over areas first, if it is a whole multiple."""
    ratio = image.shape[0] // height
    if ratio > 1 and image.shape[:2] == (ratio * height, ratio * width):
        return image.reshape(height, ratio, width, ratio, -1).mean((1, 3))
    out = image
    for axis, size in ((0, height), (1, width)):
        place = np.clip((np.arange(size) + 0.5) * out.shape[axis] / size - 0.5, 0, out.shape[axis] - 1)
        low = np.minimum(place.astype(int), out.shape[axis] - 2)
        part = (place - low).reshape([-1 if i == axis else 1 for i in range(out.ndim)])
        out = (1 - part) * np.take(out, low, axis) + part * np.take(out, low + 1, axis)
    return out.astype(np.float32)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
