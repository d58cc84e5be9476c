"""Opening and streaming clips: formats, transparency, and a sentence for each kind of bad input."""

from __future__ import annotations

import itertools
import struct
from fractions import Fraction

import av
import cv2
import numpy as np
import pytest

from backend.contract.errors import BackendError
from backend.contract.job import FramesConfig
from backend.io import working_frames
from backend.io.images import encode_srgb
from backend.io.video import open_clip
from backend.reporting import SilentReport
from backend.stages import frames

W, H, N = 64, 48, 12


def ramp(k: int, channels: int = 3, dtype=np.uint8) -> np.ndarray:
    """[H, W, C]: a horizontal ramp that brightens with time, so that frames can be told apart."""
    image = np.zeros((H, W, channels), np.float64)
    image[..., :3] = (np.linspace(0, 0.6, W)[None, :, None] + 0.03 * k) * [1.0, 0.8, 0.6]
    if channels == 4:
        image[..., 3] = np.linspace(0, 1, H)[:, None]
    return (image * np.iinfo(dtype).max).astype(dtype)


def encode(path, images, codec="libx264", pix_fmt="yuv420p", rate=25, options=None, container_options=None, metadata=None):
    with av.open(str(path), "w", options=container_options or {}) as container:
        stream = container.add_stream(codec, rate=rate, options=options or {})
        stream.width, stream.height, stream.pix_fmt = images[0].shape[1], images[0].shape[0], pix_fmt
        for key, value in (metadata or {}).items():
            stream.metadata[key] = value
        for image in images:
            form = "rgba" if image.shape[2] == 4 else "rgb24"
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format=form)))
        container.mux(stream.encode())
    return path


def write_images(folder, images, name="shot_{:04d}.png", first=1):
    folder.mkdir(exist_ok=True)
    for k, image in enumerate(images, start=first):
        order = [2, 1, 0, 3][: image.shape[2]]
        assert cv2.imwrite(str(folder / name.format(k)), image[..., order])
    return folder


def refused(path) -> BackendError:
    with pytest.raises(BackendError) as caught, open_clip(path) as clip:
        for _ in clip.frames():
            pass
    assert caught.value.message.endswith(".") and caught.value.hint.endswith(".")
    return caught.value


@pytest.mark.parametrize(
    ("name", "codec", "pix_fmt"),
    [("a.mp4", "libx264", "yuv420p"), ("a.mov", "mpeg4", "yuv420p"), ("a.webm", "libvpx-vp9", "yuv420p"),
     ("b.webm", "libvpx", "yuv420p"), ("a.mkv", "mjpeg", "yuvj420p")],
)  # fmt: skip
def test_video_formats(tmp_path, name, codec, pix_fmt) -> None:
    path = encode(tmp_path / name, [ramp(k) for k in range(N)], codec, pix_fmt)
    with open_clip(path) as clip:
        assert (clip.width, clip.height, clip.num_frames, clip.has_alpha, clip.bit_depth) == (W, H, N, False, 8)
        assert clip.fps == pytest.approx(25.0, rel=1e-3)
        images = list(clip.frames())
    assert len(images) == N
    for k, image in enumerate(images):
        assert np.abs(image.astype(int) - ramp(k)).mean() < 6.0, f"frame {k}"


def test_gif_keeps_palette_and_transparency(tmp_path) -> None:
    images = [ramp(k) for k in range(N)]
    with open_clip(encode(tmp_path / "a.gif", images, "gif", "rgb8", rate=10)) as clip:
        assert (clip.num_frames, clip.has_alpha) == (N, False)
        assert clip.fps == pytest.approx(10.0, rel=0.02)
        assert np.abs(next(clip.frames()).astype(int) - images[0]).mean() < 30.0  # 8 bits a pixel


@pytest.mark.parametrize("codec", ["libvpx-vp9", "libvpx"])
def test_webm_alpha(tmp_path, codec) -> None:
    images = [ramp(k, 4) for k in range(N)]
    path = encode(tmp_path / "a.webm", images, codec, "yuva420p", options={"auto-alt-ref": "0"})
    with open_clip(path) as clip:
        assert clip.has_alpha and clip.num_frames == N
        image = next(clip.frames())
    assert image.shape == (H, W, 4)
    assert np.abs(image[..., 3].astype(int) - images[0][..., 3]).mean() < 4.0


def test_mov_with_alpha_and_deep_colour(tmp_path) -> None:
    path = encode(tmp_path / "a.mov", [ramp(k, 4) for k in range(4)], "prores_ks", "yuva444p10le", options={"profile": "4444"})
    with open_clip(path) as clip:
        assert clip.has_alpha and clip.bit_depth == 16
        image = next(clip.frames())
    assert image.dtype == np.uint16
    assert np.abs(image / 257.0 - ramp(0, 4)).mean() < 4.0


@pytest.mark.parametrize(("suffix", "dtype", "channels"), [("png", np.uint8, 3), ("png", np.uint16, 4), ("tif", np.uint16, 3),
                                                           ("webp", np.uint8, 4)])  # fmt: skip
def test_image_sequences(tmp_path, suffix, dtype, channels) -> None:
    images = [ramp(k, channels, dtype) for k in range(4)]
    folder = write_images(tmp_path / "seq", images, "shot_{:04d}." + suffix, first=99)
    for way in (folder, folder / f"shot_%04d.{suffix}", folder / f"shot_0100.{suffix}"):
        with open_clip(way, frame_rate=12.0) as clip:
            assert (clip.num_frames, clip.fps, clip.has_alpha) == (4, 12.0, channels == 4)
            assert clip.bit_depth == 8 * np.dtype(dtype).itemsize
            for image, expected in zip(clip.frames(), images, strict=True):
                if suffix == "webp":  # lossy, and free to put any colour where nothing shows
                    assert np.abs(image[H // 2 :].astype(int) - expected[H // 2 :]).mean() < 4.0
                else:
                    assert (image == expected).all()
    with open_clip(folder) as clip:
        assert clip.fps == 24.0


def test_frames_from_to_and_again(tmp_path) -> None:
    path = encode(tmp_path / "a.mp4", [ramp(k) for k in range(N)])
    with open_clip(path) as clip:
        everything = list(clip.frames())
        part = list(clip.frames(3, 7))
        assert len(part) == 4 and all((a == b).all() for a, b in zip(part, everything[3:7], strict=True))
        assert next(itertools.islice(clip.frames(5), 0, 1)).shape == (H, W, 3)  # left half way without harm


def test_fingerprint_names_the_content(tmp_path) -> None:
    path = encode(tmp_path / "a.mp4", [ramp(k) for k in range(N)])
    copy = tmp_path / "copy.mp4"
    copy.write_bytes(path.read_bytes())
    other = encode(tmp_path / "other.mp4", [ramp(k + 1) for k in range(N)])
    prints = [open_clip(p).fingerprint for p in (path, copy, other)]
    assert prints[0] == prints[1] != prints[2]


def test_variable_frame_rate_gives_the_mean(tmp_path) -> None:
    path = tmp_path / "v.mkv"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=1000)
        stream.width, stream.height, stream.pix_fmt = W, H, "yuv420p"
        for k, milliseconds in enumerate(np.cumsum([0] + [20, 60] * 5)):
            frame = av.VideoFrame.from_ndarray(ramp(k), format="rgb24")
            frame.pts, frame.time_base = int(milliseconds), Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    with open_clip(path) as clip:
        assert clip.fps == pytest.approx(25.0, rel=0.01)


def test_missing_empty_and_text(tmp_path) -> None:
    (tmp_path / "empty.mp4").touch()
    (tmp_path / "text.mp4").write_text("this is no video\n" * 100)
    assert refused(tmp_path / "none.mp4").code == "clip_missing"
    assert refused(tmp_path / "empty.mp4").code == "clip_empty"
    assert refused(tmp_path / "text.mp4").code == "clip_unreadable"


def test_cut_off_mp4_says_what_is_left(tmp_path) -> None:
    rng = np.random.default_rng(0)
    images = [rng.integers(0, 255, (H, W, 3), np.uint8) for _ in range(N)]
    late = encode(tmp_path / "late.mp4", images).read_bytes()
    (tmp_path / "late.mp4").write_bytes(late[: len(late) // 2])
    error = refused(tmp_path / "late.mp4")
    assert error.code == "clip_truncated" and "0 frames" in error.message
    early = encode(tmp_path / "early.mp4", images, container_options={"movflags": "faststart"}).read_bytes()
    (tmp_path / "early.mp4").write_bytes(early[: int(0.6 * len(early))])
    error = refused(tmp_path / "early.mp4")
    assert error.code == "clip_truncated" and f"of {N} frames" in error.message
    assert 0 < int(error.message.split(": ")[1].split()[0]) < N


def test_cut_off_webm_and_gif(tmp_path) -> None:
    rng = np.random.default_rng(0)
    images = [rng.integers(0, 255, (H, W, 3), np.uint8) for _ in range(50)]
    data = encode(tmp_path / "a.webm", images, "libvpx-vp9").read_bytes()
    (tmp_path / "a.webm").write_bytes(data[: len(data) // 2])
    assert refused(tmp_path / "a.webm").code == "clip_truncated"
    data = encode(tmp_path / "a.gif", images, "gif", "rgb8", rate=10).read_bytes()
    (tmp_path / "a.gif").write_bytes(data[: len(data) // 2].rstrip(b";"))
    assert refused(tmp_path / "a.gif").code in ("clip_truncated", "clip_unreadable")


def test_damage_inside_is_named(tmp_path) -> None:
    """PNG packets carry checksums, so that damage is sure to be seen."""
    path = encode(tmp_path / "a.mov", [ramp(k) for k in range(N)], "png", "rgb24")
    data = bytearray(path.read_bytes())
    marks = [k for k in range(len(data) - 3) if data[k : k + 4] == b"\x89PNG"]
    for mark in marks[6:]:
        data[mark : mark + 64] = bytes(64)
    path.write_bytes(data)
    error = refused(path)
    assert error.code == "clip_damaged" and "--frames 0:6" in error.hint


def test_too_short_and_too_small(tmp_path) -> None:
    error = refused(encode(tmp_path / "one.mp4", [ramp(0)]))
    assert error.code == "clip_too_short" and "1 frame;" in error.message
    tiny = [np.full((1, 1, 3), 9, np.uint8)] * 5
    assert refused(encode(tmp_path / "tiny.gif", tiny, "gif", "rgb8", rate=10)).code == "clip_too_small"
    assert refused(write_images(tmp_path / "tiny", tiny)).code == "clip_too_small"
    assert refused(write_images(tmp_path / "single", [ramp(0)])).code == "clip_too_short"


def test_sound_without_picture(tmp_path) -> None:
    with av.open(str(tmp_path / "sound.mp4"), "w") as container:
        stream = container.add_stream("aac", rate=44100, layout="mono")
        sound = av.AudioFrame.from_ndarray(np.zeros((1, 4096), np.float32), format="fltp", layout="mono")
        sound.rate = 44100
        container.mux(stream.encode(sound))
        container.mux(stream.encode())
    assert refused(tmp_path / "sound.mp4").code == "no_video_stream"


def test_bad_sequences(tmp_path) -> None:
    (tmp_path / "nothing").mkdir()
    assert refused(tmp_path / "nothing").code == "no_images"
    assert refused(tmp_path / "nothing" / "a_%04d.png").code == "no_images"
    assert refused(tmp_path / "a_%s.png").code == "bad_pattern"
    folder = write_images(tmp_path / "gap", [ramp(k) for k in range(6)])
    (folder / "shot_0004.png").unlink()
    error = refused(folder)
    assert error.code == "sequence_gap" and "frame 4 " in error.message
    for suffix in ("png", "jpg"):
        folder = write_images(tmp_path / suffix, [ramp(k) for k in range(5)], "shot_{:04d}." + suffix)
        write_images(folder, [ramp(0)[:-4]], "shot_{:04d}." + suffix, first=3)
        error = refused(folder)
        assert error.code == "sequence_mixed_sizes" and f"shot_0003.{suffix}" in error.message
    write_images(tmp_path / "gap", [ramp(0)], "other_{:02d}.png")
    assert refused(tmp_path / "gap").code == "sequence_ambiguous"
    broken = write_images(tmp_path / "broken", [ramp(k) for k in range(4)], "s{:d}.jpg")
    (broken / "s3.jpg").write_bytes(b"")
    assert refused(broken).code == "image_unreadable"


def test_rotation_is_applied(tmp_path) -> None:
    path = encode(tmp_path / "a.mp4", [ramp(k) for k in range(4)])
    data = bytearray(path.read_bytes())
    at = data.index(b"tkhd") + 4 + 40  # ISO 14496-12, 8.3.2: the matrix of a version 0 track header
    assert struct.unpack(">9i", data[at : at + 36])[0] == 1 << 16
    one, last = 1 << 16, 1 << 30
    data[at : at + 36] = struct.pack(">9i", 0, one, 0, -one, 0, 0, 0, 0, last)  # shown turned clockwise by 90 degrees
    path.write_bytes(data)
    with open_clip(path) as clip:
        assert (clip.width, clip.height) == (H, W)
        image = next(clip.frames())
    assert np.abs(image.astype(int) - np.rot90(ramp(0), -1)).mean() < 6.0


# -- the frames stage ---------------------------------------------------------------------------------------------


def test_working_size_and_range(tmp_path) -> None:
    with open_clip(encode(tmp_path / "a.mp4", [ramp(k) for k in range(N)])) as clip:
        assert frames.working_size(clip, FramesConfig(working_size=32)) == (32, 24)
        assert frames.working_size(clip, FramesConfig(working_size=4000)) == (W, H)
        assert frames.frame_range(clip, None, None) == (0, N)
        assert frames.frame_range(clip, 2, 6) == (2, 6)
        for start, stop in ((0, N + 1), (N, N + 3), (5, 5), (-1, 4)):
            with pytest.raises(BackendError) as caught:
                frames.frame_range(clip, start, stop)
            assert caught.value.code == "frame_range_outside"
        with pytest.raises(BackendError) as caught:
            frames.frame_range(clip, 2, 4)
        assert caught.value.code == "frame_range_too_short"
        images = list(frames.run(clip, FramesConfig(working_size=32), SilentReport(), frame_start=2, frame_stop=6))
    assert len(images) == 4 and all(i.shape == (24, 32, 4) and i.dtype == np.float32 for i in images)
    assert all((i[..., 3] == 1.0).all() for i in images)


def test_reduction_averages_light_not_code() -> None:
    """Black and white lines seen from afar are half the light, sRGB code 188, not 128."""
    image = np.zeros((32, 32, 3), np.uint8)
    image[::2] = 255
    small = working_frames.reduced(image, (8, 8))
    assert np.allclose(small[..., :3], 0.5, atol=1e-6)
    assert encode_srgb(small[..., :3])[0, 0, 0] == 188


def test_reduction_weighs_colour_by_alpha() -> None:
    """A transparent green pixel beside an opaque red one leaves no green."""
    image = np.zeros((16, 16, 4), np.uint8)
    image[:, ::2], image[:, 1::2] = (0, 255, 0, 0), (255, 0, 0, 255)
    small = working_frames.reduced(image, (8, 16))
    assert np.allclose(small, [1.0, 0.0, 0.0, 0.5], atol=1e-6)
    image[:, ::2] = 0  # premultiplied: nothing shines where alpha is 0
    small = working_frames.reduced(image, (8, 16), is_premultiplied=True)
    assert np.allclose(small, [1.0, 0.0, 0.0, 0.5], atol=1e-6)


@pytest.mark.parametrize("is_premultiplied", [True, False])
def test_premultiplied_alpha_is_recognised(tmp_path, is_premultiplied) -> None:
    y, x = np.mgrid[0:64, 0:64] / 63.0
    layers = []
    for k in range(4):
        alpha = np.exp(-(((x - 0.5) ** 2 + (y - 0.5 + 0.02 * k) ** 2) / 0.05))
        color = 0.6 * np.ones((64, 64, 3)) * (alpha[..., None] if is_premultiplied else 1.0)
        layers.append(encode_srgb(np.concatenate([color, alpha[..., None]], axis=2).astype(np.float32)))
    report = SilentReport()
    with open_clip(write_images(tmp_path / "s", layers)) as clip:
        images = list(frames.run(clip, FramesConfig(), report, frame_start=0, frame_stop=4))
    assert [code for code, _ in report.warnings] == ["alpha_premultiplied"] * is_premultiplied
    seen = images[0][images[0][..., 3] > 0.1]
    assert np.abs(seen[:, :3] - 0.6).max() < 0.02  # straight again, either way
