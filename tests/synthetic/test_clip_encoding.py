"""PNG frames to mp4 and back."""

from __future__ import annotations

from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from backend.contract.errors import BackendError
from synthetic.clip import encode_clip


def write_frames(folder: Path, *, size: tuple[int, int] = (48, 32), count: int = 6) -> list[Path]:
    paths = []
    for frame in range(count):
        y, x = np.mgrid[: size[1], : size[0]].astype(np.float32)
        image = np.stack([90 + x, 120 + 0.5 * y + 4 * frame, 200 - x], axis=-1)
        paths.append(folder / f"{frame:04d}.png")
        cv2.imwrite(str(paths[-1]), image.clip(0, 255).astype(np.uint8))
    return paths


def decode(path: Path) -> list[np.ndarray]:
    with av.open(str(path)) as container:
        return [cv2.cvtColor(frame.to_ndarray(format="yuv420p"), cv2.COLOR_YUV2BGR_I420) for frame in container.decode(video=0)]


def test_frames_come_back_without_a_shift_in_brightness(tmp_path: Path) -> None:
    paths = write_frames(tmp_path)
    encode_clip(paths, tmp_path / "clip.mp4", fps=12.0, quality=6)
    decoded = decode(tmp_path / "clip.mp4")
    assert len(decoded) == len(paths)
    for path, image in zip(paths, decoded, strict=True):
        difference = image.astype(float) - cv2.imread(str(path)).astype(float)
        assert np.abs(difference.mean(axis=(0, 1))).max() < 0.6
        assert np.abs(difference).mean() < 2.0
    with av.open(str(tmp_path / "clip.mp4")) as container:
        assert float(container.streams.video[0].average_rate) == 12.0


def test_the_same_frames_give_the_same_bytes(tmp_path: Path) -> None:
    paths = write_frames(tmp_path)
    for name in ("a.mp4", "b.mp4"):
        encode_clip(paths, tmp_path / name, fps=24.0)
    assert (tmp_path / "a.mp4").read_bytes() == (tmp_path / "b.mp4").read_bytes()


def test_bad_frames_leave_no_clip(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="at least one"):
        encode_clip([], tmp_path / "clip.mp4", fps=24.0)
    with pytest.raises(ValueError, match="even"):
        encode_clip(write_frames(tmp_path, size=(33, 32)), tmp_path / "clip.mp4", fps=24.0)
    (tmp_path / "no.png").write_text("no image")
    with pytest.raises(BackendError, match="no image"):
        encode_clip([tmp_path / "no.png"], tmp_path / "clip.mp4", fps=24.0)
    assert not (tmp_path / "clip.mp4").exists()
