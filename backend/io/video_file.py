"""A video file as a clip, decoded by FFmpeg."""

from __future__ import annotations

import contextlib
import struct
from collections.abc import Generator, Iterator
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from pathlib import Path
from typing import cast

import av
import numpy as np
from av.container import InputContainer
from av.error import FFmpegError
from av.video.codeccontext import VideoCodecContext
from av.video.frame import VideoFrame
from av.video.reformatter import Colorspace
from av.video.stream import VideoStream

from backend.contract.errors import BackendError
from backend.io.fingerprints import content_fingerprint

# One packet, one shown frame: counted without decoding. Others (VP8 and VP9 have hidden frames) are decoded.
_ONE_FRAME_A_PACKET = ("h264", "hevc", "av1", "mpeg4", "mpeg2video", "mpeg1video", "mjpeg", "prores", "dnxhd", "qtrle", "png")
_ALPHA_DECODERS = {"vp8": "libvpx", "vp9": "libvpx-vp9"}  # FFmpeg's own decoders of these drop the alpha plane
_HD_HEIGHT = 720  # px; untagged video from this height on is BT.709, below BT.601
_UNSPECIFIED = 2  # AVCOL_SPC_UNSPECIFIED
_DEFAULT_FPS = 24.0


@dataclass(frozen=True, slots=True, kw_only=True)
class _Scan:
    """What one pass tells. fps: mean over the clip, 0 where the packets carry no times."""

    num_frames: int
    fps: float
    has_alpha: bool


class VideoFile:
    """mp4, mov, webm, gif and whatever else FFmpeg reads."""

    def __init__(self, path: Path, *, frame_rate: float = 0.0) -> None:
        self.name = path.name
        self._path = path
        is_cut = _is_cut(path)
        with self._open() as container:
            stream = container.streams.video[0]
            self._may_have_alpha = _declares_alpha(stream)
            declared = stream.frames if "mov" in container.format.name else 0
            self._time_base = stream.time_base or Fraction(1)
            average = float(stream.average_rate or 0.0)
            duration = 0.0 if container.duration is None else container.duration / av.time_base
            has_trusted_duration = "matroska" in container.format.name
        scan = self._scan()
        if has_trusted_duration and scan.fps > 0:
            declared = round(duration * scan.fps)
            is_cut = scan.num_frames < 0.8 * declared - 5  # writers round up, by some frames
        elif scan.num_frames < declared:
            is_cut = True
        if is_cut:
            raise self._cut_error(declared)
        first = next(self._decoded(), None)
        if first is None:
            raise self._unreadable("holds no frame that can be decoded")
        self.num_frames = scan.num_frames
        is_average_right = average > 0 and abs(average - scan.fps) < 2e-3 * average
        self.fps = frame_rate or (average if is_average_right or scan.fps <= 0 else scan.fps) or _DEFAULT_FPS
        self.has_alpha = scan.has_alpha
        self.bit_depth = 16 if _is_deep(first) else 8
        self.height, self.width = _upright(first, has_alpha=False).shape[:2]

    @property
    def fingerprint(self) -> str:
        return self._fingerprint

    @cached_property
    def _fingerprint(self) -> str:
        return content_fingerprint([self._path])

    def frames(self, start: int = 0, stop: int | None = None) -> Iterator[np.ndarray]:
        """Frames start to stop-1, [H, W, 3 or 4] uint8 or uint16, sRGB-coded. Raises BackendError at a damaged frame.

        Decoding begins at frame 0, because seeking is not exact in every format.
        """
        stop = self.num_frames if stop is None else min(stop, self.num_frames)
        index = 0
        decoded = self._decoded()
        for index, frame in enumerate(decoded):
            if index >= stop:
                decoded.close()
                return
            if index < start:
                continue
            if frame.is_corrupt:
                raise self._damage_error(index)
            image = _upright(frame, has_alpha=self.has_alpha)
            if image.shape[:2] != (self.height, self.width):
                raise BackendError(
                    "clip_changes_size",
                    f"{self.name} changes its size at frame {index}.",
                    hint="Export the clip again with one size, or cut it there.",
                )
            yield image
        if index + 1 < stop:
            raise self._damage_error(index + 1)

    def close(self) -> None:
        """Nothing is held open between passes."""

    def __enter__(self) -> VideoFile:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _open(self) -> InputContainer:
        try:
            container = av.open(str(self._path))
        except (FFmpegError, ValueError) as error:
            raise self._unreadable("is not a video that can be read") from error
        if container.streams.video:
            container.streams.video[0].thread_type = "AUTO"
            return container
        has_sound = bool(container.streams.audio)
        container.close()
        if has_sound:
            raise BackendError(
                "no_video_stream", f"{self.name} holds sound but no picture.", hint="Give a file with a video track."
            )
        raise self._unreadable("is not a video that can be read")

    def _decoded(self) -> Generator[VideoFrame]:
        """All frames in order; ends at the first damage."""
        with self._open() as container:
            stream = container.streams.video[0]
            codec = _ALPHA_DECODERS.get(stream.codec_context.name) if self._may_have_alpha else None
            decoder = cast(VideoCodecContext, VideoCodecContext.create(codec, "r")) if codec else stream.codec_context
            with contextlib.suppress(FFmpegError):
                for packet in container.demux(stream):
                    yield from decoder.decode(packet if packet.size else None)

    def _scan(self) -> _Scan:
        """Counts frames, from the packets alone where each holds one and transparency need not be looked for."""
        with self._open() as container:
            stream = container.streams.video[0]
            if not self._may_have_alpha and stream.codec_context.name in _ONE_FRAME_A_PACKET:
                times: list[float | None] = []
                with contextlib.suppress(FFmpegError):  # the file ends inside a packet: the count tells
                    times = [_seconds(packet) for packet in container.demux(stream) if packet.size]
                return _Scan(num_frames=len(times), fps=_mean_rate(times), has_alpha=False)
        times, has_alpha = [], False
        for frame in self._decoded():
            times.append(None if frame.pts is None else float(frame.pts * self._time_base))
            if self._may_have_alpha and not has_alpha:
                image = _upright(frame, has_alpha=True)
                has_alpha = bool(image[..., 3].min() < np.iinfo(image.dtype).max)
        return _Scan(num_frames=len(times), fps=_mean_rate(times), has_alpha=has_alpha)

    def _cut_error(self, declared: int) -> BackendError:
        readable = sum(1 for _ in self._decoded())
        of_all = f" of {declared}" if declared > readable else ""
        return BackendError(
            "clip_truncated",
            f"{self.name} ends early: {readable}{of_all} frames can be read.",
            hint="Copy or export it again; to go on with what is there, save it as a new file with a video editor.",
        )

    def _damage_error(self, index: int) -> BackendError:
        return BackendError(
            "clip_damaged",
            f"{self.name} cannot be decoded beyond frame {index - 1}; it should have {self.num_frames} frames.",
            hint=f"Export the clip again, or use the frames before the damage with --frames 0:{index}.",
        )

    def _unreadable(self, problem: str) -> BackendError:
        return BackendError(
            "clip_unreadable", f"{self.name} {problem}.", hint="Give an mp4, mov, webm or gif, or a sequence of images."
        )


def _seconds(packet: av.Packet) -> float | None:
    return None if packet.pts is None or packet.time_base is None else float(packet.pts * packet.time_base)


def _mean_rate(times: list[float | None]) -> float:
    """Frames a second over the clip, from presentation times s; 0 where they tell nothing."""
    known = [time for time in times if time is not None]
    span = max(known) - min(known) if known else 0.0
    return (len(known) - 1) / span if span > 0 else 0.0


def _declares_alpha(stream: VideoStream) -> bool:
    """Whether the pixels may be transparent: by pixel format, or in WebM by the alpha_mode tag."""
    if stream.metadata.get("alpha_mode") == "1" or stream.metadata.get("ALPHA_MODE") == "1":
        return True
    pixel_format = stream.codec_context.format
    return pixel_format is not None and any(component.is_alpha for component in pixel_format.components)


def _is_deep(frame: VideoFrame) -> bool:
    return max(component.bits for component in frame.format.components) > 8


def _upright(frame: VideoFrame, *, has_alpha: bool) -> np.ndarray:
    """[H, W, 3 or 4] uint8 or uint16, turned as the file says."""
    names = ("rgba64le", "rgba") if has_alpha else ("rgb48le", "rgb24")
    matrix = None
    if not frame.format.is_rgb and frame.colorspace == _UNSPECIFIED:
        matrix = Colorspace.ITU709 if frame.height >= _HD_HEIGHT else Colorspace.ITU601
    image = frame.reformat(format=names[0 if _is_deep(frame) else 1], src_colorspace=matrix).to_ndarray()
    quarters = round(frame.rotation / 90.0) % 4  # counter-clockwise
    return np.ascontiguousarray(np.rot90(image, quarters)) if quarters else image


def _is_cut(path: Path) -> bool:
    """Whether an mp4, mov or gif ends before its own structure does.

    ISO 14496-12: a file is a row of boxes, size and type first. Raises BackendError where the index (moov) is gone.
    """
    length = path.stat().st_size
    with open(path, "rb") as handle:
        head = handle.read(12)
        if head[:4] == b"GIF8":
            handle.seek(max(0, length - 64))
            return b";" not in handle.read()  # the trailer byte
        if head[4:8] not in (b"ftyp", b"moov", b"mdat", b"wide", b"free", b"skip"):
            return False
        position, names = 0, set()
        while position + 8 <= length:
            handle.seek(position)
            size, name = struct.unpack(">I4s", handle.read(8))
            if size == 1:
                size = struct.unpack(">Q", handle.read(8).ljust(8, b"\0"))[0]
            names.add(name)
            position = length if size == 0 else position + max(size, 8)
    if b"moov" not in names:
        raise BackendError(
            "clip_truncated",
            f"{path.name} ends early: its index, which is written last, is missing, so 0 frames can be read.",
            hint="Copy or export it again; recover a broken recording with the camera maker's tool.",
        )
    return position > length
