"""Smoke that needs no matting: an alpha channel, or a black background."""

from __future__ import annotations

from fractions import Fraction

import av
import h5py
import numpy as np
import pytest

from backend.contract.errors import BackendError
from backend.contract.job import ExtractionConfig
from backend.fit import on_black
from backend.io.frame_stack import FrameStack, FrameStackWriter
from backend.io.images import decode_srgb, encode_srgb, linear_to_srgb, read_image, read_linear, srgb_to_linear, write_png
from backend.reporting import SilentReport
from backend.stages import smoke

H, W = 90, 160


def puff(k: int = 0) -> np.ndarray:
    """[h, w] opacity 0..0.9 of a soft puff that drifts upwards, with nothing around it."""
    y, x = np.mgrid[0:H, 0:W].astype(np.float32)
    opacity = 0.95 * np.exp(-(((x - 80) / 18) ** 2) - ((y - 50 + k) / 16) ** 2) - 0.05
    return np.clip(opacity * (1 + 0.1 * np.sin(x / 4) * np.sin(y / 5)), 0, 1)


def on_black_clip(*, level: int = 0, noise: float = 0.0, num: int = 8) -> list[np.ndarray]:
    """Frames [h, w, 4] as decoded from 8 bits: grey smoke on a black of `level` with noise in 8-bit steps."""
    rng = np.random.default_rng(0)
    frames = []
    for k in range(num):
        light = 0.7 * puff(k)[..., None] * np.ones(3) + srgb_to_linear(np.array(level / 255.0))
        code = encode_srgb(light.astype(np.float32)) + np.round(rng.normal(0, noise, (H, W, 3)))
        linear = decode_srgb(np.clip(code, 0, 255).astype(np.uint8))
        frames.append(np.concatenate([linear, np.ones((H, W, 1), np.float32)], axis=2))
    return frames


@pytest.mark.parametrize(("level", "noise"), [(0, 0.0), (5, 0.0), (16, 0.0), (0, 1.0), (5, 1.5)])
def test_smoke_on_black_is_recognised_and_left_alone(level, noise) -> None:
    frames = on_black_clip(level=level, noise=noise)
    layer = smoke.run(frames, ExtractionConfig(), SilentReport(), has_alpha=False)
    assert layer.mode == "on_black" and layer.plate is None
    assert layer.measured["black_level"] == pytest.approx(level / 255, abs=1.5 / 255)
    black = srgb_to_linear(np.array(layer.measured["black_level"]))
    for k, (image, frame) in enumerate(zip(layer.frames, frames, strict=True)):
        far = puff(k) == 0.0
        assert (image[far] == 0.0).mean() > 0.98  # the black is exactly empty, but for a rim
        strong = puff(k) > 0.1
        assert np.abs(image[..., :3] - (frame[..., :3] - black))[strong].max() < 1e-5  # the smoke is untouched
        expected = np.minimum(0.7 * puff(k) / layer.measured["opaque_luminance"], 1.0)
        assert np.abs(image[..., 3] - expected)[strong].max() < 0.01 + 0.025 * noise
    assert layer.measured["opaque_luminance"] == pytest.approx(0.7 * puff().max(), rel=0.1)


def test_black_clip_has_no_smoke() -> None:
    for level in (0, 5):
        frames = [np.full((H, W, 4), srgb_to_linear(np.array(level / 255)), np.float32)] * 5
        with pytest.raises(BackendError) as caught:
            smoke.run(frames, ExtractionConfig(), SilentReport(), has_alpha=False)
        assert caught.value.code == "no_smoke"


def test_dark_scene_is_not_taken_for_a_cut_out() -> None:
    rng = np.random.default_rng(0)
    night = [srgb_to_linear(np.clip(rng.normal(0.1, 0.03, (H, W, 4)), 0, 1)).astype(np.float32) for _ in range(4)]
    assert not on_black.measure_black(night).is_black


def test_specks_on_black_are_dropped() -> None:
    frames = on_black_clip()
    for frame in frames:
        frame[5, 5, :3] = 0.002  # a coding error far from the smoke, below what smoke must reach
    layer = smoke.run(frames, ExtractionConfig(), SilentReport(), has_alpha=False)
    assert all((image[:12, :12] == 0.0).all() for image in layer.frames)


def test_alpha_becomes_premultiplied() -> None:
    opacity = puff()[..., None].astype(np.float32)
    frame = np.concatenate([np.full((H, W, 3), 0.5, np.float32), opacity], axis=2)
    layer = smoke.run([frame] * 4, ExtractionConfig(), SilentReport(), has_alpha=True)
    image = next(layer.frames)
    assert layer.mode == "alpha"
    assert np.allclose(image[..., :3], 0.5 * opacity) and np.allclose(image[..., 3:], opacity)
    assert np.allclose(layer.smoke_color, 0.5, atol=1e-4)


def test_mode_of_the_settings_wins_and_alpha_must_exist() -> None:
    layer = smoke.run(on_black_clip(), ExtractionConfig(mode="on_black"), SilentReport(), has_alpha=False)
    assert layer.mode == "on_black" and "settings" in layer.reason
    with pytest.raises(BackendError) as caught:
        smoke.run(on_black_clip(), ExtractionConfig(mode="alpha"), SilentReport(), has_alpha=False)
    assert caught.value.code == "no_alpha"
    empty = [np.zeros((H, W, 4), np.float32)] * 4
    with pytest.raises(BackendError) as caught:
        smoke.run(empty, ExtractionConfig(), SilentReport(), has_alpha=True)
    assert caught.value.code == "no_smoke"


def test_unreadable_mask_names_the_file(tmp_path) -> None:
    (tmp_path / "mask.png").write_text("no image")
    for config, code in (
        (ExtractionConfig(garbage_matte=str(tmp_path / "mask.png")), "image_unreadable"),
        (ExtractionConfig(garbage_matte=str(tmp_path / "none.png")), "image_missing"),
    ):
        with pytest.raises(BackendError) as caught:
            smoke.run(on_black_clip(), config, SilentReport(), has_alpha=False)
        assert caught.value.code == code


# -- sRGB, PNG, frame stacks --------------------------------------------------------------------------------------


def test_srgb_by_hand_and_back() -> None:
    """IEC 61966-2-1: code 0.5 is 0.21404 of the light; 0.04045 is the end of the straight part."""
    assert srgb_to_linear(np.array(0.5)) == pytest.approx(0.2140411, abs=1e-7)
    assert srgb_to_linear(np.array(0.04045)) == pytest.approx(0.04045 / 12.92, abs=1e-9)
    codes = np.linspace(0, 1, 1001)
    assert np.abs(linear_to_srgb(srgb_to_linear(codes)) - codes).max() < 1e-7
    assert (np.diff(srgb_to_linear(codes)) > 0).all()


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_every_code_survives(dtype) -> None:
    codes = np.arange(np.iinfo(dtype).max + 1).astype(dtype)
    image = np.stack([codes, codes, codes, codes], axis=1)[None]
    assert (encode_srgb(decode_srgb(image), dtype) == image).all()
    odd = np.array([[[np.nan, -1.0, 2.0]]], np.float32)
    assert encode_srgb(odd, dtype).tolist() == [[[0, 0, np.iinfo(dtype).max]]]


@pytest.mark.parametrize(("channels", "bit_depth"), [(3, 8), (4, 8), (3, 16), (4, 16)])
def test_png_keeps_values(tmp_path, channels, bit_depth) -> None:
    linear = np.random.default_rng(0).random((7, 9, channels)).astype(np.float32)
    write_png(tmp_path / "a.png", linear, bit_depth=bit_depth)
    assert read_image(tmp_path / "a.png").dtype == {8: np.uint8, 16: np.uint16}[bit_depth]
    assert np.abs(read_linear(tmp_path / "a.png") - linear).max() < {8: 6e-3, 16: 3e-5}[bit_depth]
    with pytest.raises(ValueError, match="an image is"):
        write_png(tmp_path / "a.png", linear[..., 0])


def test_frame_stack_round_trip_and_same_bytes(tmp_path) -> None:
    frames = np.random.default_rng(0).random((5, 8, 12, 4)).astype(np.float32)
    for name in ("a.h5", "b.h5"):
        with h5py.File(tmp_path / name, "w") as file:
            writer = FrameStackWriter(file, "frames", 5, (8, 12, 4))
            for frame in frames:
                writer.append(frame)
            with pytest.raises(ValueError, match="full"):
                writer.append(frames[0])
    assert (tmp_path / "a.h5").read_bytes() == (tmp_path / "b.h5").read_bytes()
    with h5py.File(tmp_path / "a.h5") as file:
        stack = FrameStack(file, "frames")
        assert len(stack) == 5 and stack.shape == (8, 12, 4)
        assert np.abs(np.stack(list(stack)) - frames).max() < 4e-5
        assert (stack[-1] == stack[4]).all() and stack[0].dtype == np.float32
        with pytest.raises(IndexError):
            stack[5]
        with pytest.raises(BackendError):
            FrameStack(file, "others")


def test_exr_is_linear_light(tmp_path) -> None:
    """FFmpeg stores planes in the order G, B, R; the image comes back as R, G, B, and values are not sRGB."""
    image = np.zeros((16, 16, 3), np.float32)
    image[:] = [0.5, 0.25, 0.125]
    codec = av.CodecContext.create("exr", "w")
    codec.width, codec.height, codec.pix_fmt, codec.time_base = 16, 16, "gbrpf32le", Fraction(1, 24)
    packets = codec.encode(av.VideoFrame.from_ndarray(image, format="gbrpf32le")) + codec.encode(None)
    (tmp_path / "a.exr").write_bytes(b"".join(bytes(packet) for packet in packets))
    assert np.abs(read_linear(tmp_path / "a.exr") - image).max() < 1e-4
