"""Matting against a known truth: a plate, smoke of known opacity, and the noise of a video codec."""

from __future__ import annotations

import av
import cv2
import numpy as np
import pytest

from backend.contract.errors import BackendError
from backend.contract.job import ExtractionConfig, FramesConfig
from backend.io.images import encode_srgb, srgb_to_linear, write_png
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


def test_layer_over_the_plate_gives_the_frame_back(filmed) -> None:
    frames, _, _ = filmed
    layer = smoke_stage.run(frames, ExtractionConfig(), SilentReport(), has_alpha=False)
    for image, frame in zip(layer.frames, frames, strict=True):
        again = layer.plate * (1 - image[..., 3:]) + image[..., :3]
        assert np.abs(again - frame[..., :3]).mean() < 0.01
        assert (image[..., :3][image[..., 3] == 0.0] == 0.0).all()
        assert image.dtype == np.float32 and (image[..., 3] >= 0).all() and (image[..., 3] <= 1).all()


def test_given_plate_and_masks_have_the_last_word(filmed, tmp_path) -> None:
    frames, truth, plate = filmed
    write_png(tmp_path / "plate.png", plate, bit_depth=16)
    matte = np.ones((HEIGHT, WIDTH, 3), np.float32)
    matte[:, : WIDTH // 2] = 0.0
    write_png(tmp_path / "matte.png", matte)
    config = ExtractionConfig(clean_plate=str(tmp_path / "plate.png"), garbage_matte=str(tmp_path / "matte.png"))
    layer = smoke_stage.run(frames, config, SilentReport(), has_alpha=False)
    assert np.abs(layer.plate - plate).max() < 1e-3
    errors = []
    for image, opacity in zip(layer.frames, truth, strict=True):
        assert (image[:, : WIDTH // 2] == 0.0).all()
        right = opacity[:, WIDTH // 2 :]
        errors.append(np.abs(image[:, WIDTH // 2 :, 3] - right)[right > 0.02].mean())
    assert np.mean(errors) < 0.06


def test_smoke_mask_keeps_what_would_be_dropped(filmed, tmp_path) -> None:
    frames, _, plate = filmed
    write_png(tmp_path / "plate.png", plate, bit_depth=16)
    write_png(tmp_path / "mask.png", np.ones((HEIGHT, WIDTH, 3), np.float32))
    with_mask = ExtractionConfig(clean_plate=str(tmp_path / "plate.png"), smoke_mask=str(tmp_path / "mask.png"))
    without = ExtractionConfig(clean_plate=str(tmp_path / "plate.png"))
    sums = [
        sum(f[..., 3].sum() for f in smoke_stage.run(frames[:6], c, SilentReport(), has_alpha=False).frames)
        for c in (with_mask, without)
    ]
    assert sums[0] > sums[1]


def test_scene_without_smoke_is_refused(tmp_path) -> None:
    rng = np.random.default_rng(0)
    plate = encode_srgb(textured_plate()).astype(int)
    write_h264(tmp_path / "a.mp4", [np.clip(plate + rng.normal(0, 3, plate.shape), 0, 255).astype(np.uint8) for _ in range(16)])
    with pytest.raises(BackendError) as caught:
        smoke_stage.run(read_frames(tmp_path / "a.mp4"), ExtractionConfig(), SilentReport(), has_alpha=False)
    assert caught.value.code == "no_smoke"


def test_passing_car_and_shaking_tree_are_no_smoke() -> None:
    """A red box crosses the picture, a textured patch sways: neither is a mixture of the background and one grey."""
    rng = np.random.default_rng(2)
    plate = textured_plate()
    tree = (rng.random((40, 40, 3)) * [0.2, 0.5, 0.1]).astype(np.float32)
    clip = []
    for k in range(30):
        image = plate.copy()
        shift = round(3 * np.sin(k))
        image[20:60, 60 + shift : 100 + shift] = tree
        image[110:125, 8 * k : 8 * k + 24] = [0.5, 0.03, 0.02]
        clip.append(np.concatenate([image, np.ones((HEIGHT, WIDTH, 1), np.float32)], axis=2))
    with pytest.raises(BackendError) as caught:
        smoke_stage.run(clip, ExtractionConfig(), SilentReport(), has_alpha=False)
    assert caught.value.code == "no_smoke"


def test_turning_camera_is_stabilised() -> None:
    """A camera that pans over a wide plate sees the same background again; opacity is still found."""
    wide = cv2.resize(textured_plate(3), (2 * WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)
    rng = np.random.default_rng(0)
    wide = np.clip(wide + 0.15 * cv2.GaussianBlur(rng.normal(0, 1, wide.shape).astype(np.float32), (0, 0), 1.5), 0.01, 1)
    clip, truth = [], []
    for k in range(30):
        offset = 60 + round(25 * np.sin(k / 6))
        opacity = np.roll(plume_opacity(k), 60 - offset, axis=1)
        image = composite(wide[:, offset : offset + WIDTH], opacity, k)
        clip.append(np.concatenate([image, np.ones((HEIGHT, WIDTH, 1), np.float32)], axis=2))
        truth.append(opacity)
    layer = smoke_stage.run(clip, ExtractionConfig(), SilentReport(), has_alpha=False)
    assert "turns" in layer.reason
    pairs = list(zip(layer.frames, truth, strict=True))
    assert np.mean([np.abs(i[..., 3] - t)[t > 0.02].mean() for i, t in pairs]) < 0.12
    assert np.mean([i[..., 3][t == 0].mean() for i, t in pairs]) < 0.02


def test_plume_that_never_clears() -> None:
    """The background in the middle is never seen; the fill from around it must not be smoke."""
    plate, clip, truth = textured_plate(), [], []
    for k in range(NUM):
        truth.append(plume_opacity(k, cover=1.0))
        image = encode_srgb(composite(plate, truth[-1], k)).astype(np.float32) / 255.0
        clip.append(np.concatenate([srgb_to_linear(image), np.ones((HEIGHT, WIDTH, 1))], axis=2).astype(np.float32))
    layer = smoke_stage.run(clip, ExtractionConfig(), SilentReport(), has_alpha=False)
    pairs = list(zip(layer.frames, truth, strict=True))
    assert np.mean([np.abs(i[..., 3] - t)[t > 0.02].mean() for i, t in pairs]) < 0.1
    assert np.mean([i[..., 3][t == 0].mean() for i, t in pairs]) < 0.01
