"""Numbered images as a clip."""

from __future__ import annotations

import itertools
import re
import struct
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path

import numpy as np

from backend.contract.errors import BackendError
from backend.io.fingerprints import content_fingerprint
from backend.io.images import read_image

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".webp", ".bmp", ".exr", ".hdr")
DEFAULT_FPS = 24.0
_ALPHA_SAMPLES = 8  # frames looked at for transparency
_NUMBERED = re.compile(r"^(.*?)(\d+)(\D*)$")  # prefix, last run of digits, rest with the suffix


class ImageSequence:
    """Image files in order. Sizes are checked up front for PNG, and for every file when it is read."""

    def __init__(self, files: list[Path], *, name: str, frame_rate: float = 0.0) -> None:
        first = read_image(files[0])
        self.name = name
        self.height, self.width = first.shape[:2]
        self.num_frames = len(files)
        self.fps = frame_rate or DEFAULT_FPS
        self.bit_depth = 8 * first.dtype.itemsize
        self._files = files
        for file in files:
            size = _png_size(file)
            if size is not None:
                self._check_size(file, *size)
        self.has_alpha = self._find_alpha(first)

    @property
    def fingerprint(self) -> str:
        return self._fingerprint

    @cached_property
    def _fingerprint(self) -> str:
        return content_fingerprint(self._files)

    def frames(self, start: int = 0, stop: int | None = None) -> Iterator[np.ndarray]:
        """Frames start to stop-1, [H, W, 3 or 4] uint8 or uint16, sRGB-coded. Raises BackendError at a bad file."""
        for file in self._files[start:stop]:
            image = read_image(file)
            self._check_size(file, image.shape[1], image.shape[0])
            yield image

    def close(self) -> None:
        """Nothing is held open between frames."""

    def __enter__(self) -> ImageSequence:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _check_size(self, file: Path, width: int, height: int) -> None:
        if (width, height) != (self.width, self.height):
            raise BackendError(
                "sequence_mixed_sizes",
                f"{file.name} is {width} x {height} pixels, but the sequence begins with {self.width} x {self.height}.",
                hint="Give images of one size, or move the others to another folder.",
            )

    def _find_alpha(self, first: np.ndarray) -> bool:
        if first.shape[2] < 4:
            return False
        for index in np.unique(np.linspace(0, self.num_frames - 1, _ALPHA_SAMPLES).astype(int)):
            image = first if index == 0 else read_image(self._files[index])
            if image.shape[2] == 4 and image[..., 3].min() < np.iinfo(image.dtype).max:
                return True
        return False


def find_images(path: Path) -> list[Path]:
    """The images of a folder, of a %04d pattern, or the numbered siblings of one image. Raises BackendError."""
    if "%" in path.name:
        return _of_pattern(path)
    if path.is_dir():
        return _of_folder(path)
    match = _NUMBERED.match(path.name)
    if match is None:
        return [path]
    prefix, _, rest = match.groups()
    return _in_order(_numbered(path.parent, prefix, rest), path.name)


def _of_pattern(path: Path) -> list[Path]:
    match = re.match(r"^([^%]*)%0?\d*d([^%]*)$", path.name)
    if match is None:
        raise BackendError(
            "bad_pattern", f"{path.name} is not a pattern of numbered files.", hint="Write it as shot_%04d.png, with one %."
        )
    found = _numbered(path.parent, *match.groups())
    if not found:
        raise BackendError("no_images", f"No file matches {path}.", hint="Check the folder and the pattern.")
    return _in_order(found, path.name)


def _of_folder(folder: Path) -> list[Path]:
    """All images of a folder: one numbered sequence, or names in alphabetical order where none has a number."""
    images = sorted(p for p in folder.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES and not p.name.startswith("."))
    if not images:
        raise BackendError(
            "no_images",
            f"{folder} holds no images.",
            hint=f"Give a folder with numbered images ({', '.join(s[1:] for s in IMAGE_SUFFIXES)}).",
        )
    patterns: dict[tuple[str, str], list[Path]] = {}
    for image in images:
        match = _NUMBERED.match(image.name)
        if match is None:
            return images
        patterns.setdefault((match[1], match[3]), []).append(image)
    if len(patterns) > 1:
        names = [f"{prefix}{'#' * 4}{rest}" for prefix, rest in sorted(patterns)]
        raise BackendError(
            "sequence_ambiguous",
            f"{folder} holds {len(patterns)} image sequences: {', '.join(names[:3])}.",
            hint="Give one image of the sequence you mean instead of the folder.",
        )
    ((prefix, rest),) = patterns
    return _in_order(_numbered(folder, prefix, rest), folder.name)


def _numbered(folder: Path, prefix: str, rest: str) -> dict[int, Path]:
    """Files prefix + digits + rest by their number."""
    pattern = re.compile(re.escape(prefix) + r"(\d+)" + re.escape(rest))
    if not folder.is_dir():
        raise BackendError("clip_missing", f"There is no folder {folder}.", hint="Check the path.")
    return {int(match[1]): p for p in sorted(folder.iterdir()) if (match := pattern.fullmatch(p.name))}


def _in_order(found: dict[int, Path], name: str) -> list[Path]:
    numbers = sorted(found)
    missing = next((a + 1 for a, b in itertools.pairwise(numbers) if b != a + 1), None)
    if missing is not None:
        raise BackendError(
            "sequence_gap",
            f"{name}: frame {missing} is missing between {numbers[0]} and {numbers[-1]}.",
            hint="Render or copy the missing frame, or move the frames behind the gap to another folder.",
        )
    return [found[number] for number in numbers]


def _png_size(file: Path) -> tuple[int, int] | None:
    """(width, height) from the header chunk (PNG specification 11.2.2); None for another format."""
    with open(file, "rb") as handle:
        head = handle.read(24)
    if head[:8] != b"\x89PNG\r\n\x1a\n" or head[12:16] != b"IHDR" or len(head) < 24:
        return None
    width, height = struct.unpack(">II", head[16:24])
    return width, height
