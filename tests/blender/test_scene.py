"""A finished job in Blender: the volume, the camera, the picture that Cycles makes of it. Twice, in both wheels.

A small plume with swirl is made here with the backend, and what a ray through its grids must gather; the wheels' checks
read both from the folder that WILDSMOKE_TEST_JOB names.
"""

from __future__ import annotations

import os
import subprocess
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from backend.contract import result as contract
from backend.contract.cameras import Cameras
from backend.contract.job import ExportConfig
from backend.geometry.camera import view_at
from backend.io import vdb
from backend.io.particles import ParticleFrame, Particles, ParticlesInfo, ParticlesWriter, read_particles
from backend.reporting import SilentReport
from backend.stages import export

pytestmark = pytest.mark.blender
INSIDE = "inside_scene.py"
CHECKOUT = Path(vdb.__file__).resolve().parents[2]
NUM_FRAMES, NUM_FORECAST = 7, 1
SEEN = 4  # the frame of the asset that is compared


@pytest.fixture(scope="module", autouse=True)
def job(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    if vdb.openvdb_module() is None and not os.environ.get(vdb.PYTHON_VARIABLE):
        pytest.skip("no OpenVDB to write the job with")
    folder = tmp_path_factory.mktemp("plume")
    make_job(folder)
    os.environ["WILDSMOKE_TEST_JOB"] = str(folder)
    yield folder
    del os.environ["WILDSMOKE_TEST_JOB"]


def test_inside(passed: bool) -> None:
    assert passed


def test_the_process_ends(wheel, finished_cleanly) -> None:
    assert finished_cleanly(wheel) is None


def test_the_script_makes_a_blend_and_a_preview(job: Path, tmp_path: Path, wheel: str, find_wheel_python) -> None:
    command = [find_wheel_python(wheel), CHECKOUT / "addon" / "scene" / "build_blend.py", "--job", job]
    outputs = [
        "--blend",
        tmp_path / "new" / "smoke.blend",
        "--preview",
        tmp_path / "preview.png",
        "--frame",
        "5",
        "--samples",
        "4",
    ]
    done = subprocess.run([str(part) for part in command + outputs], capture_output=True, text=True, check=False, cwd=tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    assert (tmp_path / "new" / "smoke.blend").stat().st_size > 10_000
    picture = cv2.imread(str(tmp_path / "preview.png"))
    assert picture.shape == (160, 120, 3)
    command[-1] = tmp_path / "no_job"
    done = subprocess.run([str(part) for part in command], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "holds no finished job" in done.stderr


def test_the_script_keeps_the_smoke_alone(job: Path, tmp_path: Path, wheel: str, find_wheel_python) -> None:
    """What an evaluation scores; a picture that is there already is not drawn again."""
    command = [find_wheel_python(wheel), CHECKOUT / "addon" / "scene" / "build_blend.py", "--job", job, "--samples", "4"]
    command += ["--layers", tmp_path / "layers", "--layer-frames", "2,5", "--longest-side", "80"]
    (tmp_path / "layers").mkdir()
    (tmp_path / "layers" / "0002.npy").write_bytes(b"drawn before")
    done = subprocess.run([str(part) for part in command], capture_output=True, text=True, check=False, cwd=tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    assert [line for line in done.stdout.splitlines() if line.startswith("layer")] == ["layer 2", "layer 5"]
    assert sorted(path.name for path in (tmp_path / "layers").iterdir()) == ["0002.npy", "0005.npy"]
    layer = np.load(tmp_path / "layers" / "0005.npy")
    assert layer.shape == (80, 60, 4) and np.isfinite(layer).all() and 0.3 < layer[..., 3].max() <= 1.0
    assert np.percentile(layer[..., 3], 5) < 0.01, "nothing but smoke"


def make_job(folder: Path) -> None:
    """particles.h5, the VDB sequence, cameras.json, a plate, result.json; expected.npz: opacity and colour of one frame."""
    cameras = cameras_around()
    (folder / contract.CAMERAS_FILE).write_text(cameras.to_json())
    with ParticlesWriter(folder / contract.PARTICLES_FILE) as writer:
        for frame in range(NUM_FRAMES + NUM_FORECAST):
            writer.append(plume(frame, count=3000 if frame < NUM_FRAMES else 0), is_forecast=frame >= NUM_FRAMES)
        writer.finish(ParticlesInfo(cameras=cameras, gravity=(0.0, 0.0, -9.81)))
    plate = np.full((cameras.height, cameras.width, 3), (90, 60, 30), np.uint8)
    cv2.imwrite(str(folder / "background.png"), plate)
    config, report = ExportConfig(max_voxels=48), SilentReport()
    with read_particles(folder / contract.PARTICLES_FILE) as particles:
        plan = export.plan_export(particles, config, report)
        for _ in export.write_sequence(export.run(particles, config, report, plan=plan), folder / contract.VDB_FOLDER):
            pass
        np.savez(folder / "expected.npz", **gathered(particles, plan, cameras))
    made = contract.Result(
        particles=contract.PARTICLES_FILE,
        cameras=contract.CAMERAS_FILE,
        vdb_folder=contract.VDB_FOLDER,
        num_frames=NUM_FRAMES,
        num_forecast=NUM_FORECAST,
        frame_start=0,
        fps=23.976,
        voxel_size=plan.voxel_size,
        has_color=plan.has_color,
        smoke_color=plan.smoke_color,
        bounds=plan.bounds,
        buoyancy=(0.0, 0.0, 1.0),
        background_plate="background.png",
    )
    assert made.has_color
    (folder / contract.RESULT_FILE).write_text(made.to_json())


def plume(frame: int, *, count: int) -> ParticleFrame:
    """A widening column that swirls about z and leans to +x; warm below, grey above."""
    chance = np.random.default_rng(0)
    height, angle, radius = chance.random(count), chance.random(count) * 2 * np.pi, np.sqrt(chance.random(count))
    turned = angle + 3 * height - 0.25 * frame
    width = (0.08 + 0.28 * height) * (1 + 0.3 * np.sin(7 * height - 0.8 * frame))
    x, y = radius * width * np.cos(turned) + 0.35 * height**2, radius * width * np.sin(turned)
    warm = np.stack([0.8 - 0.3 * height, 0.5 + 0 * height, 0.3 + 0.2 * height], axis=1)
    return ParticleFrame(
        positions=np.stack([x, y, 0.1 + 2.4 * height + 0.02 * frame], axis=1),
        velocities=np.stack([-6 * y, 6 * x, np.full(count, 0.5)], axis=1),
        scales=0.05 + 0.04 * height,
        optical_masses=2.0 / max(count, 1) * (1 - 0.6 * height),
        colors=warm,
        ids=np.arange(count),
    )


def cameras_around() -> Cameras:
    """A camera that moves a little on a circle, its axis off the picture's centre."""
    matrices = []
    for azimuth in np.linspace(0.0, 0.3, NUM_FRAMES + NUM_FORECAST):
        eye = np.array([5 * np.sin(azimuth), -5 * np.cos(azimuth), 1.6])
        forward = np.array([0.1, 0.0, 1.3]) - eye
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        matrix = np.eye(4)
        matrix[:3] = np.stack([right, np.cross(forward, right), forward, eye], axis=1)
        matrices.append(tuple(tuple(row) for row in matrix.tolist()))
    return Cameras(width=120, height=160, fx=200.0, fy=200.0, cx=64.0, cy=74.5, fps=23.976, camera_to_world=tuple(matrices))


def gathered(particles: Particles, plan: export.ExportPlan, cameras: Cameras) -> dict[str, np.ndarray]:
    """Opacity [H, W] and radiance [H, W, 3] along the rays through pixel centres: exp(-tau) of the interpolated grid."""
    (made,) = export.run(particles, ExportConfig(), SilentReport(), start=SEEN, stop=SEEN + 1, plan=plan)
    view = view_at(cameras, SEEN)
    x, y = np.meshgrid(np.arange(view.width) + 0.5, np.arange(view.height) + 0.5)
    pixels = np.stack([x.ravel(), y.ravel()], axis=1)
    ways = view.unproject(pixels, np.ones(len(pixels))) - view.position
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    step, transmittance, radiance = 0.02, np.ones(len(pixels)), np.zeros((len(pixels), 3))
    for way in np.arange(3.5, 7.0, step):
        at = ((view.position + way * ways - np.array(made.origin)) / made.voxel_size).T
        opacity = -np.expm1(-step * map_coordinates(made.grids["density"], at, order=1))
        color = np.stack([map_coordinates(made.grids["color"][..., c], at, order=1) for c in range(3)], axis=1)
        radiance += (transmittance * opacity)[:, None] * color
        transmittance *= 1 - opacity
    return {"opacity": (1 - transmittance).reshape(x.shape), "radiance": radiance.reshape(*x.shape, 3)}
