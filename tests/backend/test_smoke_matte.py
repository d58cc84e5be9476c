"""Matting against a known truth: a plate, smoke of known opacity, and the noise of a video codec."""

from __future__ import annotations

import av
import cv2
import numpy as np
import pytest

from backend.contract.errors import BackendError
from backend.contract.job import ExtractionConfig, FramesConfig
from backend.fit import clean_plate, matting, sky, stabilise
from backend.io.images import encode_srgb, write_png
from backend.io.video import open_clip
from backend.reporting import SilentReport
from backend.stages import frames as frames_stage
from backend.stages import smoke as smoke_stage

WIDTH, HEIGHT, NUM = 256, 144, 48
SMOKE = np.array([0.62, 0.6, 0.58], np.float32)  # linear


def textured_plate(seed: int = 1) -> np.ndarray:
    """[h, w, 3] linear: blotches of several sizes and a few straight edges, darker and lighter than the smoke."""
    rng = np.random.default_rng(seed)
    plate = np.zeros((HEIGHT, WIDTH, 3), np.float32)
    for cells, gain in ((4, 0.5), (12, 0.3), (48, 0.2)):
        noise = rng.random((max(2, cells * HEIGHT // WIDTH), cells, 3)).astype(np.float32)
        plate += gain * cv2.resize(noise, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)
    plate[90:, 40:110] *= np.array([0.5, 0.35, 0.3], np.float32)
    plate[70:, 170:200] = 0.05
    return np.clip(0.5 * plate, 0.01, 0.9)


def plume_opacity(frame: int, *, cover: float = 0.45) -> np.ndarray:
    """[h, w] 0..1: billows of two layers that rise at different speeds inside a widening, swaying plume.

    cover: how much of the plume's middle is smoke at any moment; 1 never shows the background there.
    """
    rng = np.random.default_rng(5)
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH].astype(np.float32)
    height = np.clip((128 - y) / 128, 0, 1)
    sway = 14 * np.sin(frame / 9.0 + 3 * height) * height
    across = (x - (120 + 45 * height**1.5 + sway)) / (5 + 34 * height)
    envelope = np.exp(-(across**2) * 1.5) * (y < 128) * np.clip((128 - y) / 6, 0, 1)
    billows = np.zeros((HEIGHT, WIDTH), np.float32)
    for cells, speed, gain in ((8, 3.1, 0.6), (20, 2.3, 0.4)):
        noise = rng.random((4 * cells, cells)).astype(np.float32)
        tall = cv2.resize(noise, (WIDTH, 4 * WIDTH), interpolation=cv2.INTER_CUBIC)
        billows += gain * np.roll(tall, -round(speed * frame), axis=0)[:HEIGHT]
    tau = 14.0 * envelope * np.maximum(billows - (0.5 + 0.35 * (0.5 - cover)), 0.0) + 2.0 * (cover == 1.0) * envelope
    tau[tau < 0.02] = 0.0
    return (1.0 - np.exp(-tau)).astype(np.float32)


def composite(plate: np.ndarray, opacity: np.ndarray, frame: int = 0) -> np.ndarray:
    """Smoke over the plate; its lit and shaded sides differ by a fifth and drift with it."""
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH].astype(np.float32)
    shade = 1.0 + 0.1 * np.sin(x / 6.0 + 1.3 * np.sin(y / 9.0)) * np.cos((y + 2.7 * frame) / 8.0)
    return plate * (1 - opacity[..., None]) + SMOKE * (shade * opacity)[..., None]


def write_h264(path, images, *, fps: int = 24, crf: int = 23) -> None:
    """images: [H, W, 3] uint8."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=fps, options={"crf": str(crf), "preset": "veryfast"})
        first = True
        for image in images:
            if first:
                stream.height, stream.width = image.shape[:2]
                stream.pix_fmt = "yuv420p"
                first = False
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode())


def read_frames(path, size: int = WIDTH) -> list[np.ndarray]:
    with open_clip(path) as clip:
        config = FramesConfig(working_size=size)
        return list(frames_stage.run(clip, config, SilentReport(), frame_start=0, frame_stop=clip.num_frames))


@pytest.fixture(scope="module")
def filmed(tmp_path_factory):
    """A still camera, H.264: the decoded frames and the true opacities."""
    path = tmp_path_factory.mktemp("filmed") / "plume.mp4"
    plate, opacities = textured_plate(), [plume_opacity(k) for k in range(NUM)]
    write_h264(path, (encode_srgb(composite(plate, a, k)) for k, a in enumerate(opacities)))
    return read_frames(path), opacities, plate


def test_still_camera_opacity_is_near_the_truth(filmed) -> None:
    frames, truth, _ = filmed
    layer = smoke_stage.run(frames, ExtractionConfig(), SilentReport(), has_alpha=False)
    assert layer.mode == "matte"
    inside, outside = [], []
    for image, opacity in zip(layer.frames, truth, strict=True):
        error = np.abs(image[..., 3] - opacity)
        inside.append(error[opacity > 0.02].mean())
        outside.append(error[opacity == 0.0].mean())
    print(f"mean opacity error inside {np.mean(inside):.4f}, outside {np.mean(outside):.4f}")
    assert np.mean(inside) < 0.05
    assert np.mean(outside) < 0.01
