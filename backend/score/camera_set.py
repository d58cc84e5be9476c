"""Any scene filmed by several cameras at once, as truth. docs/evaluate.md describes its folder:

    SET/NAME/cameras.json   beside a video, numbered images, or a folder `frames` of these      one camera
    SET/NAME.mp4            with SET/NAME.json, its cameras                                      another one

One of them is the input, the one that was reconstructed: that named `input` unless another is chosen. Picture k of a camera
shows video frame k, or frame `frames[k]` where its cameras.json has that list.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from backend.contract.cameras import Cameras, read_cameras
from backend.contract.errors import BackendError
from backend.contract.result import CAMERAS_FILE
from backend.contract.truth import INPUT_VIEW
from backend.geometry.camera import View, view_at
from backend.io.image_sequence import IMAGE_SUFFIXES
from backend.io.images import decode_srgb, encode_srgb, linear_to_srgb
from backend.io.video import Clip, open_clip
from backend.io.working_frames import has_premultiplied_alpha
from backend.score.truth_set import Volume

MOST_SIDE = 512  # px of the longer side that is scored; larger pictures are averaged down to it
_VIDEO_SUFFIXES = (".mkv", ".mp4", ".mov", ".webm", ".avi", ".gif")
_FRAMES_FOLDER = "frames"
_BLACK = 5 / 255  # sRGB code that still is black, where no opacity tells smoke from it
_MOST_BLACK = 20 / 255  # video black of limited range is 16
_LEAST_BLACK_SHARE = 0.05  # of the pixels
_HINT = "docs/evaluate.md describes such a folder."


@dataclass(frozen=True, slots=True, kw_only=True)
class Camera:
    """Where a camera's pictures and matrices lie."""

    name: str
    pictures: Path
    cameras: Path


class CodedPictures:
    """Pictures [F, H, W, 4] uint16, decoded when they are asked for: float32 [H, W, 4] linear premultiplied."""

    def __init__(self, coded: np.ndarray) -> None:
        self._coded = coded

    def __len__(self) -> int:
        return len(self._coded)

    def __getitem__(self, index: int, /) -> np.ndarray:
        return decode_srgb(self._coded[index])


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraSet:
    """A set of cameras without volumes. frames, cameras, clips: by view; the input's is called as everywhere, others
    "camera NAME". sizes: (width, height) that is scored."""

    name: str
    num_seen: int
    frames: dict[str, list[int]]
    cameras: dict[str, Cameras]
    clips: dict[str, Path]
    sizes: dict[str, tuple[int, int]]

    @property
    def fps(self) -> float:
        return self.cameras[INPUT_VIEW].fps

    @property
    def future_views(self) -> tuple[str, ...]:
        return tuple(self.frames)

    def view(self, name: str, frame: int) -> View:
        cameras = self.cameras[name]
        return view_at(cameras, 0 if cameras.is_still else frame, size=self.sizes[name])

    def pictures(self, name: str) -> CodedPictures:
        """Of each of frames[name]. Raises BackendError where they are damaged or do not stand on black."""
        with open_clip(self.clips[name]) as clip:
            is_premultiplied = clip.has_alpha and has_premultiplied_alpha(clip.frames())
            count = len(self.frames[name])
            width, height = self.sizes[name]
            found = np.empty((count, height, width, 4), np.uint16)
            for index, image in enumerate(clip.frames(0, count)):
                found[index] = encode_srgb(on_black(image, (width, height), is_premultiplied=is_premultiplied), np.uint16)
            if not clip.has_alpha:
                _check_black(self.clips[name], found)
        return CodedPictures(found)

    def volume_frames(self) -> list[int]:
        return []

    def volume(self, frame: int) -> Volume:
        raise KeyError(frame)


def read_camera_set(folder: Path, *, num_seen: int, input_name: str = INPUT_VIEW) -> CameraSet:
    """num_seen: frames that were fitted; later ones are the future. Raises BackendError where the folder is no such set."""
    found = find_cameras(folder)
    names = ", ".join(sorted(camera.name for camera in found))
    if not found:
        raise BackendError("truth_missing", f"{folder} holds neither a benchmark scene nor cameras.", hint=_HINT)
    if input_name not in {camera.name for camera in found}:
        raise BackendError(
            "no_input_camera",
            f'{folder} has no camera "{input_name}"; it has {names}.',
            hint="Name the one that was fitted: --input.",
        )
    if len(found) == 1:
        raise BackendError("truth_too_small", f"{folder} has the camera {names} only.", hint=f"Add another camera. {_HINT}")
    frames: dict[str, list[int]] = {}
    cameras: dict[str, Cameras] = {}
    clips: dict[str, Path] = {}
    sizes: dict[str, tuple[int, int]] = {}
    for camera in sorted(found, key=lambda camera: (camera.name != input_name, camera.name)):
        view = INPUT_VIEW if camera.name == input_name else f"camera {camera.name}"
        with open_clip(camera.pictures) as clip:
            frames[view] = _frames_of(camera, clip.num_frames)
            cameras[view] = read_cameras(camera.cameras, num_frames=frames[view][-1] + 1)
            _check_shape(camera, clip, cameras[view])
            sizes[view] = _scored_size(clip)
        clips[view] = camera.pictures
    if frames[INPUT_VIEW] != list(range(len(frames[INPUT_VIEW]))) or len(frames[INPUT_VIEW]) < num_seen:
        raise BackendError(
            "job_of_other_frames",
            f"The job holds {num_seen} frames, the camera {input_name} shows {len(frames[INPUT_VIEW])}.",
            hint="Give every frame of the input camera, from the first on.",
        )
    last = len(frames[INPUT_VIEW])
    for view, shown in frames.items():
        frames[view] = [frame for frame in shown if frame < last]
        if not any(frame < num_seen for frame in shown):
            raise BackendError("no_common_frames", f"The {view} shows none of the {num_seen} fitted frames.", hint=_HINT)
    return CameraSet(
        name=folder.resolve().name,
        num_seen=num_seen,
        frames=frames,
        cameras=cameras,
        clips=clips,
        sizes=sizes,
    )


def find_cameras(folder: Path) -> list[Camera]:
    """The cameras of a folder. Raises BackendError where one of them is half there."""
    found = []
    for path in sorted(folder.iterdir()) if folder.is_dir() else []:
        if path.is_dir() and (path / CAMERAS_FILE).is_file():
            found.append(Camera(name=path.name, pictures=_pictures_in(path), cameras=path / CAMERAS_FILE))
        elif path.suffix.lower() in _VIDEO_SUFFIXES:
            cameras = path.with_suffix(".json")
            if not cameras.is_file():
                raise BackendError("cameras_missing", f"{path} has no {cameras.name} beside it.", hint=_HINT)
            found.append(Camera(name=path.stem, pictures=path, cameras=cameras))
    return found


def on_black(image: np.ndarray, size: tuple[int, int], *, is_premultiplied: bool) -> np.ndarray:
    """[H, W, 3 or 4] sRGB-coded -> [h, w, 4] linear premultiplied light and opacity at size (width, height). Without alpha
    the fourth channel is how bright the light is coded: enough to tell where there is smoke."""
    linear = decode_srgb(image)
    if linear.shape[2] == 4 and not is_premultiplied:
        linear[..., :3] *= linear[..., 3:]
    if (linear.shape[1], linear.shape[0]) != size:
        linear = cv2.resize(linear, size, interpolation=cv2.INTER_AREA)
    if linear.shape[2] == 4:
        return linear
    brightness = np.maximum(linear_to_srgb(linear).max(axis=2, keepdims=True) - _BLACK, 0.0)
    return np.concatenate([linear, brightness.astype(np.float32)], axis=2)


def _pictures_in(folder: Path) -> Path:
    """The one thing in a camera's folder that shows something."""
    videos = [path for path in sorted(folder.iterdir()) if path.suffix.lower() in _VIDEO_SUFFIXES]
    images = [folder] if any(path.suffix.lower() in IMAGE_SUFFIXES for path in folder.iterdir()) else []
    found = videos + images + ([folder / _FRAMES_FOLDER] if (folder / _FRAMES_FOLDER).is_dir() else [])
    if len(found) != 1:
        what = ", ".join(path.name for path in found) or "no pictures"
        raise BackendError("pictures_missing", f"{folder} holds {what}; one video or one sequence is needed.", hint=_HINT)
    return found[0]


def _frames_of(camera: Camera, count: int) -> list[int]:
    """Which video frame each picture shows."""
    try:
        listed = json.loads(camera.cameras.read_text(encoding="utf-8")).get("frames")
    except (OSError, ValueError, AttributeError, RecursionError):
        listed = None  # read_cameras says what is wrong with the file
    if listed is None:
        return list(range(count))
    is_list = isinstance(listed, list) and all(isinstance(frame, int) and not isinstance(frame, bool) for frame in listed)
    if not is_list or len(listed) != count or listed != sorted(set(listed)) or listed[0] < 0:
        raise BackendError(
            "frames_do_not_match",
            f"{camera.cameras} does not list the video frame of each of the {count} pictures in order.",
            hint="Give a rising list of as many whole numbers, or leave `frames` out.",
        )
    return listed


def _check_shape(camera: Camera, clip: Clip, cameras: Cameras) -> None:
    if abs(clip.width / clip.height / (cameras.width / cameras.height) - 1.0) > 0.02:
        raise BackendError(
            "cameras_do_not_match",
            f"{camera.cameras} is for {cameras.width} x {cameras.height} pixels, the pictures of {camera.name} have "
            f"{clip.width} x {clip.height}.",
            hint="Give the intrinsics of the pictures; another size is no matter, another shape is.",
        )


def _scored_size(clip: Clip) -> tuple[int, int]:
    scale = min(1.0, MOST_SIDE / max(clip.width, clip.height))
    return max(1, round(clip.width * scale)), max(1, round(clip.height * scale))


def _check_black(path: Path, coded: np.ndarray) -> None:
    """That what is opaque stands on black: else the background would be scored, not the smoke."""
    brightest = coded[:: max(1, len(coded) // 8), ..., :3].max(axis=-1)
    if np.mean(brightest <= _MOST_BLACK * np.iinfo(np.uint16).max) < _LEAST_BLACK_SHARE:
        raise BackendError(
            "truth_not_on_black",
            f"{path} shows a background, not smoke on black.",
            hint="Give the smoke alone, or with its opacity as alpha.",
        )
