"""Speed of the renderer, forward and backward, beside the torch twin and the processor's matrix product.

    python -m benchmarks.render_speed [--json] [--repeats R] [--features K] [--twin-pixels M]

Prints the median milliseconds of a plume of 5k and 50k Gaussians at three sizes; how many times longer the twin takes
(measured here, on a crop and a part of the Gaussians, scaled by Gaussians x pixels, for it sums all of them directly);
and the share of the peak: 80 flop per covered pair of Gaussian and cell, against a float32 matrix product on as many
threads (the fastest run of each). A pair is covered where the splat is above exp(-12.5) of its peak, on its own level.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import time
from collections.abc import Callable
from typing import Any

import numba
import numpy as np
import torch

from backend.geometry.camera import View
from backend.render import splat, torch_twin
from backend.render.gaussians import Gaussians
from backend.render.projection import CUT

FLOP_PER_PAIR = 80  # forward and backward of one weight, by hand count
COUNTS = (5_000, 50_000)
SIZES = ((480, 270), (960, 540), (1920, 1080))


def camera(width: int, height: int) -> View:
    """At the origin, looking along z; 45 degrees of horizontal field of view."""
    focal = 0.5 * width / np.tan(np.radians(22.5))
    return View(width=width, height=height, fx=focal, fy=focal, cx=width / 2, cy=height / 2, camera_to_world=np.eye(4))


def plume(num: int) -> Gaussians:
    """A rising, widening plume at 3 m that covers about 30 % of the frame; aspect up to 2, sizes as the spacing."""
    random = np.random.default_rng(0)
    height = random.uniform(-0.62, 0.6, num)
    radius = 0.08 + 0.10 * (height + 0.6)
    across = random.normal(size=(num, 2)) * radius[:, None] * 0.8
    spacing = (1.2 * np.pi * 0.2**2 / num) ** (1 / 3)
    return Gaussians(
        positions=np.stack([across[:, 0], -height, 3.0 + across[:, 1]], axis=1),
        scales=spacing * random.uniform(0.7, 1.4, (num, 3)),
        rotations=random.normal(size=(num, 4)),
        optical_masses=np.full(num, 0.5 / num),
        colors=random.uniform(size=(num, 3)),
    )


def timed_ms(work: Callable[[], object], repeats: int) -> tuple[float, float]:
    """Median and fastest of the repeats; on a busy machine the two differ widely."""
    work()
    taken = []
    for _ in range(repeats):
        begin = time.perf_counter()
        work()
        taken.append((time.perf_counter() - begin) * 1e3)
    return float(np.median(taken)), min(taken)


def median_ms(work: Callable[[], object], repeats: int) -> float:
    return timed_ms(work, repeats)[0]


def covered_pairs(drawn: splat.Splat) -> float:
    """Cells in all splats: the area of an ellipse where the exponent is -CUT, as far as it lies in the box."""
    geometry = drawn.geometry
    seen = geometry.levels >= 0
    a, b, boxes = geometry.splats[seen, 2], geometry.splats[seen, 3], geometry.boxes[seen]
    ellipse = 2 * np.pi * CUT / np.sqrt(a * b)
    box = (boxes[:, 1] - boxes[:, 0] + 1.0) * (boxes[:, 3] - boxes[:, 2] + 1.0)
    return float(np.minimum(ellipse, box).sum())


def product_gflops(repeats: int) -> float:
    """Billions of operations a second of a float32 matrix product of 1536."""
    torch.set_num_threads(numba.get_num_threads())
    x = torch.rand(1536, 1536)
    return 2 * 1536**3 / timed_ms(lambda: x @ x, repeats)[1] / 1e6


def twin_ms_per_gaussian_pixel(num_features: int, twin_pixels: int) -> float:
    """Forward and backward of the twin in float32, per Gaussian and pixel."""
    side = max(8, int(np.sqrt(twin_pixels)))
    view, gaussians, num = camera(side, side), plume(256), 256
    arrays = (
        gaussians.positions,
        gaussians.scales,
        gaussians.rotations,
        gaussians.optical_masses,
        gaussians.colors[:, :num_features],
    )
    inputs = [torch.tensor(array, dtype=torch.float32, requires_grad=True) for array in arrays]
    return median_ms(lambda: torch_twin.render(*inputs, view).sum().backward(), 3) / num / side**2


def measure(num: int, size: tuple[int, int], num_features: int, repeats: int) -> dict[str, Any]:
    view, gaussians = camera(*size), plume(num)
    features = gaussians.colors[:, :num_features].copy()
    drawn = splat.forward(gaussians, view, features=features)
    grad = np.random.default_rng(1).normal(size=drawn.image.shape).astype(np.float32)
    forward = median_ms(lambda: splat.forward(gaussians, view, features=features), repeats)
    backward = median_ms(lambda: splat.backward(drawn, grad), repeats)
    both, fastest = timed_ms(lambda: splat.backward(splat.forward(gaussians, view, features=features), grad), repeats)
    return {
        "gaussians": num,
        "width": size[0],
        "height": size[1],
        "covered": float((drawn.image[0] > 1e-2 * drawn.image[0].max()).mean()),
        "pairs": covered_pairs(drawn),
        "forward_ms": forward,
        "backward_ms": backward,
        "both_ms": both,
        "both_fastest_ms": fastest,
        "reweighted_ms": median_ms(lambda: splat.reweighted(drawn, gaussians.optical_masses, features), repeats),
        "adjoint_mass_ms": median_ms(lambda: splat.adjoint_mass(drawn, grad[0]), repeats),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description="Speed of the optical-depth renderer.")
    parser.add_argument("--json", action="store_true", help="one JSON object instead of a table")
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--features", type=int, default=0, help="channels beside the optical depth (colour: 3)")
    parser.add_argument("--twin-pixels", type=int, default=4096, help="pixels of the image that the twin is timed on")
    options = parser.parse_args()
    peak = product_gflops(options.repeats)
    twin = twin_ms_per_gaussian_pixel(min(options.features, 3), options.twin_pixels)
    rows = []
    for num in COUNTS:
        for size in SIZES:
            row = measure(num, size, min(options.features, 3), options.repeats)
            row["twin_ratio"] = twin * num * size[0] * size[1] / row["both_ms"]
            row["share_of_peak"] = FLOP_PER_PAIR * row["pairs"] / (row["both_fastest_ms"] * 1e6) / peak
            rows.append(row)
    machine = {
        "processor": platform.processor() or platform.machine(),
        "cores": os.cpu_count(),
        "threads": numba.get_num_threads(),
        "load": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
    }
    if options.json:
        print(
            json.dumps({"machine": machine, "product_gflops": peak, "features": options.features, "rows": rows}, allow_nan=False)
        )
        return
    print(f"{machine}; matrix product {peak:.0f} Gflop/s; {options.features} features; median of {options.repeats}")
    print("gaussians      size  cover  forward  backward     both  (fastest)  reweighted  adjoint  x twin  of peak")
    for r in rows:
        size = f"{r['width']}x{r['height']}"
        print(
            f"{r['gaussians']:9d} {size:>9s} {r['covered']:6.0%} {r['forward_ms']:8.1f} {r['backward_ms']:9.1f}"
            f" {r['both_ms']:8.1f} {r['both_fastest_ms']:10.1f} {r['reweighted_ms']:11.1f} {r['adjoint_mass_ms']:8.1f}"
            f" {r['twin_ratio']:7.0f} {r['share_of_peak']:8.1%}"
        )


if __name__ == "__main__":
    main()
