"""What a user gets wrong is answered with one sentence on what and one on how, and exit code 2; each with its own code."""

from __future__ import annotations

import json
import os
import resource
import shutil
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from small_job import backend, settings

STILL = [[1, 0, 0, 0], [0, 0, 1, -10], [0, -1, 0, 0], [0, 0, 0, 1]]
FLAT = [[1, 0, 0, 0], [0, 0, 1, -10], [0, 0, 0, 0], [0, 0, 0, 1]]


def encode(path: Path, frames: list[np.ndarray]) -> Path:
    """frames [H, W, 3] uint8 -> H.264 mp4, its index at the end."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=Fraction(24))
        stream.height, stream.width = frames[0].shape[:2]
        stream.pix_fmt = "yuv444p" if frames[0].shape[0] % 2 else "yuv420p"
        for frame in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        container.mux(stream.encode())
    return path


def noise(size: tuple[int, int], count: int) -> list[np.ndarray]:
    random = np.random.default_rng(0)
    return [random.integers(0, 255, (*size, 3), np.uint8) for _ in range(count)]


def empty_file(folder: Path) -> Path:
    (folder / "clip.mp4").touch()
    return folder / "clip.mp4"


def text_file(folder: Path) -> Path:
    (folder / "clip.mp4").write_text("not a film\n" * 100)
    return folder / "clip.mp4"


def truncated(folder: Path) -> Path:
    path = encode(folder / "clip.mp4", noise((64, 64), 20))
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    return path


def one_frame(folder: Path) -> Path:
    return encode(folder / "clip.mp4", noise((64, 64), 1))


def one_pixel(folder: Path) -> Path:
    for number in range(8):
        cv2.imwrite(str(folder / f"{number:04d}.png"), np.full((1, 1, 3), 20 * number, np.uint8))
    return folder


def no_smoke(folder: Path) -> Path:
    y, x = np.mgrid[0:72, 0:96]
    scene = np.stack([90 + 80 * np.sin(x / 5), 100 + 60 * np.sin(y / 7), 40 + 1.5 * y], axis=2).astype(np.uint8)
    return encode(folder / "clip.mp4", [scene] * 20)


def mixed_sizes(folder: Path) -> Path:
    for number in range(6):
        cv2.imwrite(str(folder / f"{number:04d}.png"), np.full((32, 32 + (number == 4), 3), 90, np.uint8))
    return folder


@pytest.mark.parametrize(
    ("make", "code"),
    [
        (lambda folder: folder / "nothing.mp4", "clip_missing"),
        (empty_file, "clip_empty"),
        (text_file, "clip_unreadable"),
        (truncated, "clip_truncated"),
        (one_frame, "clip_too_short"),
        (one_pixel, "clip_too_small"),
        (no_smoke, "no_smoke"),
        (mixed_sizes, "sequence_mixed_sizes"),
    ],
)
def test_bad_clips(make: Callable[[Path], Path], code: str, tmp_path: Path) -> None:
    folder = tmp_path / "clip"
    folder.mkdir()
    assert_refused(code, "reconstruct", make(folder), "--job", tmp_path / "job", *settings(), job=tmp_path / "job")


@pytest.mark.parametrize(
    ("matrices", "code"),
    [
        ([[[float("nan"), 0, 0, 0], *STILL[1:]]], "cameras_invalid"),
        ([FLAT], "cameras_invalid"),
        ([STILL] * 3, "cameras_too_few"),
    ],
)
def test_bad_cameras(matrices: list, code: str, plume: Path, tmp_path: Path) -> None:
    data = {"axes": "opencv", "up": "z", "width": 48, "height": 64, "fx": 80, "fy": 80, "cx": 24, "cy": 32, "fps": 24}
    path = tmp_path / "cameras.json"
    path.write_text(json.dumps({**data, "camera_to_world": matrices}))
    job = tmp_path / "job"
    assert_refused(code, "reconstruct", plume, "--cameras", path, "--job", job, *settings(), job=job)


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        (("--preset", "best"), "unknown_preset"),
        (("--set", "visual.colour=red"), "unknown_setting"),
        (("--set", "visual.iterations=many"), "bad_setting"),
        (("--frames", "5:5"), "bad_frame_range"),
        (("--frames", "5:500"), "frame_range_outside"),
    ],
)
def test_bad_settings(arguments: tuple[str, ...], code: str, plume: Path, tmp_path: Path) -> None:
    assert_refused(code, "reconstruct", plume, "--job", tmp_path / "job", *arguments, job=tmp_path / "job")


@pytest.mark.skipif(shutil.which("nvidia-smi") is not None, reason="this machine has CUDA")
def test_cuda_where_there_is_none(plume: Path, tmp_path: Path) -> None:
    assert_refused("no_cuda", "reconstruct", plume, "--job", tmp_path / "job", "--device", "cuda", job=tmp_path / "job")


def test_unwritable_job_folder(plume: Path, tmp_path: Path) -> None:
    (tmp_path / "job").write_text("a file stands here")
    assert_refused("not_a_folder", "reconstruct", plume, "--job", tmp_path / "job" / "inner")
    if os.geteuid() != 0:  # root may write anywhere
        locked = tmp_path / "locked"
        locked.mkdir(mode=0o555)
        assert_refused("not_writable", "reconstruct", plume, "--job", locked / "job")


def test_folder_that_the_system_refuses(tmp_path: Path) -> None:
    """What a user without rights gets; root takes off its rights for it."""
    locked = tmp_path / "locked"
    locked.mkdir(mode=0o555)
    from backend.contract.errors import BackendError
    from backend.io.job_folder import JobFolder

    child = os.fork()
    if child == 0:
        if os.geteuid() == 0:
            os.seteuid(65534)
        try:
            JobFolder(locked / "job").create()
        except BackendError as error:
            os._exit(0 if error.code == "not_writable" and error.hint else 3)
        os._exit(4)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0


def test_full_disk_keeps_what_was_computed(plume: Path, tmp_path: Path) -> None:
    """A limit on the size of files fails writes as a full disk does; without it the same job then ends well."""
    job = tmp_path / "job"
    command = ("reconstruct", plume, "--job", job, *settings())

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (12_000, resource.RLIM_INFINITY))

    assert_refused("disk_full", *command, job=job, preexec_fn=limit)
    assert not [path for path in job.rglob("*.part") if path.is_file()]
    assert backend(*command).returncode == 0


def assert_refused(code: str, *arguments: str | Path, job: Path | None = None, **options) -> None:
    done = backend(*arguments, **options)
    assert done.returncode == 2, done.stdout + done.stderr
    last = json.loads(done.stdout.splitlines()[-1])
    assert (last["event"], last["code"]) == ("error", code), last
    assert last["message"].strip().endswith((".", "!"))
    assert last["hint"].strip().endswith(".")
    assert "Traceback" not in done.stdout + done.stderr
    if job is not None:
        assert not (job / "result.json").exists()
