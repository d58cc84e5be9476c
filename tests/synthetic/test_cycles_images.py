"""What Cycles draws lies where the cameras say: points, depth, smoke, opacity. In Blender's wheel, a process of its own."""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path

import numpy as np
import pytest

from backend.contract.cameras import Cameras, read_cameras
from backend.geometry.camera import view_at
from backend.io.images import read_linear
from backend.io.vdb import write_vdb
from synthetic.sweep import look_at

CHECKOUT = Path(__file__).resolve().parents[2]
WHEELS = {name: CHECKOUT / ".venv" / name / "bin" / "python" for name in ("blender", "blender52")}
RADIUS = 0.25  # m, of the balls
BLOB = (0.4, -0.3, 2.3)  # m, middle of the smoke
BLOB_WIDTH, BLOB_PEAK = 0.35, 3.0  # m, 1/m
BALLS = [((0.0, 0.0, 2.0), RADIUS), ((2.1, 0.4, 3.4), RADIUS), ((-1.7, 3.0, 0.2), RADIUS), ((0.8, -2.6, 4.1), RADIUS)]

pytestmark = [pytest.mark.blender, pytest.mark.slow]


def run_blender(python: Path, *arguments: str | Path) -> None:
    if not python.exists():
        pytest.skip(f"{python.parent.parent.name}: this Blender wheel is not installed")
    environment = {**os.environ, "PYTHONPATH": str(CHECKOUT)}
    done = subprocess.run(
        [str(part) for part in (python, *arguments)], env=environment, capture_output=True, text=True, check=False, timeout=500
    )
    assert done.returncode == 0, done.stderr[-3000:]


def probe_cameras() -> Cameras:
    """Two places; the middle of the image is off the optical axis, so that a wrong sign of the shift shows."""
    matrices = (look_at((0.0, -12.0, 3.0), (0.0, 0.0, 2.0)), look_at((9.0, -7.0, 6.0), (0.3, 0.2, 2.0)))
    return Cameras(width=90, height=120, fx=130.0, fy=130.0, cx=38.0, cy=66.5, fps=24.0, camera_to_world=matrices)


@pytest.fixture(scope="module", params=sorted(WHEELS))
def probe(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the probe's images, by one of the wheels."""
    folder = tmp_path_factory.mktemp("probe")
    (folder / "cameras.json").write_text(probe_cameras().to_json())
    (folder / "balls.json").write_text(json.dumps(BALLS))
    h, count = 0.1, 36
    first = np.array(BLOB) - 0.5 * (count - 1) * h + 0.03
    axes = [start + h * np.arange(count) for start in first]
    x, y, z = np.meshgrid(*axes, indexing="ij")
    squared = (x - BLOB[0]) ** 2 + (y - BLOB[1]) ** 2 + (z - BLOB[2]) ** 2
    density = BLOB_PEAK * np.exp(-0.5 * squared / BLOB_WIDTH**2)
    write_vdb(folder / "smoke.vdb", {"density": density.astype(np.float32)}, voxel_size=h, origin=tuple(first))
    run_blender(WHEELS[request.param], Path(__file__).with_name("probe_scene.py"), folder, folder / "smoke.vdb")
    return folder


def centroid(weights: np.ndarray) -> np.ndarray:
    """Middle of an image's brightness, px, pixel centres at +0.5."""
    rows, columns = np.indices(weights.shape) + 0.5
    return np.array([(weights * columns).sum(), (weights * rows).sum()]) / weights.sum()


def test_known_points_land_on_their_pixels(probe: Path) -> None:
    cameras = read_cameras(probe / "cameras.json")
    for index, (position, _) in enumerate(BALLS):
        image = read_linear(probe / f"ball_{index}.png")[..., 0]
        image = np.where(image > 0.01, image, 0)  # 8-bit files are dithered
        pixel, _ = view_at(cameras, index % 2).project(np.array([position]))
        assert image.max() > 0.5
        assert np.linalg.norm(centroid(image) - pixel[0]) < 0.5


def test_depth_is_along_the_optical_axis(probe: Path) -> None:
    av = pytest.importorskip("av")
    cameras = read_cameras(probe / "cameras.json")
    for index, (position, _) in enumerate(BALLS):
        with av.open(str(probe / f"ball_{index}.exr")) as container:
            depth = next(container.decode(video=0)).to_ndarray(format="gbrapf32le")
        pixel, distance = view_at(cameras, index % 2).project(np.array([position]))
        column, row = int(pixel[0, 0]), int(pixel[0, 1])
        assert depth[row, column, 0] == pytest.approx(distance[0] - RADIUS, abs=0.05)
        assert depth[0, 0, 3] == 0  # nothing there


def test_smoke_lies_where_its_grid_says_and_is_as_opaque(probe: Path) -> None:
    """A Gaussian of extinction: optical depth through its middle is peak * width * sqrt(2 pi), eq. of a Gaussian integral."""
    cameras = read_cameras(probe / "cameras.json")
    for index in range(2):
        image = read_linear(probe / f"smoke_{index}.png")
        opacity = image[..., 3]
        pixel, _ = view_at(cameras, index).project(np.array([BLOB]))
        depth = -np.log(1 - np.clip(opacity, 0, 0.999))
        assert np.linalg.norm(centroid(depth) - pixel[0]) < 0.5
        expected = 1 - np.exp(-BLOB_PEAK * BLOB_WIDTH * np.sqrt(2 * np.pi))
        column, row = int(pixel[0, 0]), int(pixel[0, 1])
        assert opacity[row, column] == pytest.approx(expected, abs=0.02)
        assert opacity[0, 0] == 0
        assert image[..., :3].max() == 0  # no light, no bounces: black smoke


def test_smoke_is_whole_although_only_its_window_is_rendered(probe: Path) -> None:
    for index in range(2):
        image, whole = (read_linear(probe / f"{name}_{index}.png")[..., 3] for name in ("smoke", "whole"))
        rendered = np.argwhere(image > 0)
        window = tuple(slice(low, high + 1) for low, high in zip(rendered.min(0), rendered.max(0), strict=True))
        assert image[window].size < 0.5 * image.size
        outside = whole.copy()
        outside[window] = 0
        assert outside.max() < 2e-3
        assert np.abs(image - whole).max() < 0.02
