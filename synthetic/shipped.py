"""A benchmark scene small enough to ship: the smoke of each view as one lossless video, true volumes on a coarser grid.

    SCENE/input/   clip.mp4, smoke.mkv (seen frames), cameras.json (all frames)                    a method may read this
    SCENE/truth/   future.mkv; nvs/ side/ back/ each with smoke.mkv and cameras.json;              it is scored on this
                   volumes.h5, truth.json

smoke.mkv is FFV1 (RFC 9043), 8-bit RGBA: smoke on black, sRGB-coded light premultiplied with opacity, and opacity. Players
show it, and `reconstruct` takes it as a clip: it recognises that alpha is premultiplied.
Runs in the backend's environment. `truth.json` is written last: where it is, the scene is whole.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Sequence
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
from scipy import ndimage

from backend.contract.errors import BackendError
from backend.contract.result import CAMERAS_FILE, vdb_path
from backend.contract.truth import (
    CLIP_VIDEO,
    FUTURE_VIDEO,
    INPUT_FOLDER,
    INPUT_VIEW,
    SMOKE_VIDEO,
    TRUTH_FILE,
    TRUTH_FOLDER,
    VOLUMES_FILE,
    view_folder,
)
from backend.io.atomic import whole_file
from backend.io.hdf5_file import whole_hdf5
from backend.io.vdb import DenseGrid, read_vdb
from synthetic.assemble import check_rendered, scene_facts
from synthetic.clip import encode_clip
from synthetic.layers import Layer
from synthetic.plan import SMOKE_FOLDER, Image, plan_shipped, view_cameras
from synthetic.presets import Preset

SHIPPED_FOLDER = Path(__file__).resolve().parent / "bench"
DENSITY_EVERY, VELOCITY_EVERY = 5, 15  # frames
_CLIP_QUALITY = 17  # as a camera would keep it; the lossless frames are too large to ship
_STEPS = {"density": 2.0**-7, "velocity": 2.0**-5}  # 1/m, m/s: finer digits of turbulence would be half of the file
_FAINT = 0.01  # 1/m: no smoke to see
_COARSER = 2  # voxels of the simulation along an edge of one that is shipped


def pack(scene: str, folder: Path, preset: Preset, target: Path) -> Path:
    """Pack the rendered scene in `folder` into `target`. Returns the path of truth.json. Raises BackendError."""
    images = plan_shipped(preset)
    check_rendered(images, folder, command="synth render --shipped")
    num_seen = preset.num_frames - preset.num_future
    (target / TRUTH_FOLDER).mkdir(parents=True, exist_ok=True)
    (target / INPUT_FOLDER).mkdir(parents=True, exist_ok=True)
    clip = [folder / image.path for image in images if image.layer is Layer.CLIP]
    encode_clip(clip, target / INPUT_FOLDER / CLIP_VIDEO, fps=preset.fps, quality=_CLIP_QUALITY)
    frames: dict[str, list[int]] = {}
    for view, cameras in view_cameras(preset).items():
        smoke = [image for image in images if image.layer is Layer.SMOKE and image.view == view]
        frames[view] = [image.frame for image in smoke]
        place = target / view_folder(view)
        place.mkdir(parents=True, exist_ok=True)
        with whole_file(place / CAMERAS_FILE) as part:
            part.write_text(cameras.to_json(), encoding="utf-8")
        seen = [image for image in smoke if view != INPUT_VIEW or image.frame < num_seen]
        encode_smoke(_pictures(folder, seen), place / SMOKE_VIDEO, fps=preset.fps)
        if view == INPUT_VIEW:
            future = [image for image in smoke if image.frame >= num_seen]
            encode_smoke(_pictures(folder, future), target / TRUTH_FOLDER / FUTURE_VIDEO, fps=preset.fps)
    volumes = pack_volumes(folder / SMOKE_FOLDER, target / TRUTH_FOLDER / VOLUMES_FILE, num_frames=preset.num_frames)
    return _write_truth(scene, folder, preset, target, frames=frames, volumes=volumes)


def encode_smoke(pictures: Iterator[np.ndarray], target: Path, *, fps: float) -> None:
    """[H, W, 4] uint8 BGRA pictures as FFV1 in Matroska, whole or absent; the same pictures give the same bytes."""
    with whole_file(target) as part, av.open(str(part), "w", format="matroska", options={"fflags": "+bitexact"}) as container:
        stream = None
        for picture in pictures:
            if stream is None:
                stream = container.add_stream("ffv1", rate=Fraction(fps).limit_denominator(1001))
                stream.height, stream.width = picture.shape[:2]
                stream.pix_fmt = "bgra"
                stream.options = {
                    "level": "3",
                    "context": "1",
                    "slices": "24",
                    "slicecrc": "1",
                    "threads": "1",
                    "flags": "+bitexact",
                }
            container.mux(stream.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="bgra")))
        if stream is None:
            raise ValueError("a video needs at least one picture")
        container.mux(stream.encode())


def in_8_bits(picture: np.ndarray) -> np.ndarray:
    """[H, W, 4] uint16 -> uint8; light is coded and stays premultiplied. No light where opacity rounds to 0."""
    found = np.rint(picture / 257).astype(np.uint8)
    found[found[..., 3] == 0] = 0
    return found


def _pictures(folder: Path, images: Sequence[Image]) -> Iterator[np.ndarray]:
    for image in images:
        picture = cv2.imread(str(folder / image.path), cv2.IMREAD_UNCHANGED)
        if picture is None or picture.dtype != np.uint16 or picture.shape[-1] != 4:
            raise BackendError(
                "frame_unreadable",
                f"{folder / image.path} is no 16-bit picture with opacity.",
                hint="Remove it and render again.",
            )
        yield in_8_bits(picture)


def pack_volumes(smoke: Path, target: Path, *, num_frames: int) -> dict[str, object]:
    """Density every 5th and velocity every 15th frame, means over 2 x 2 x 2 voxels, all on one box. Returns what is there.

    volumes.h5: attrs voxel_size m, origin m (centre of the first voxel); density [F, X, Y, Z] 1/m, density_frames [F];
    velocity [G, X, Y, Z, 3] m/s, zero far from smoke, velocity_frames [G]; float16, in steps of 1/128 and 1/32.
    """
    air = read_vdb(vdb_path(smoke, 0), "velocity")
    shape = tuple(size // _COARSER for size in air.values.shape[:3])
    size = air.voxel_size * _COARSER
    origin = tuple(start + 0.5 * (size - air.voxel_size) for start in air.origin)
    stacks: dict[str, list[np.ndarray]] = {"density": [], "velocity": []}
    frames: dict[str, list[int]] = {"density": [], "velocity": []}
    for frame in range(0, num_frames, DENSITY_EVERY):
        for name, every in (("density", DENSITY_EVERY), ("velocity", VELOCITY_EVERY)):
            if frame % every == 0:
                grid = read_vdb(vdb_path(smoke, frame), name)
                stacks[name].append(_coarse(_placed(grid, air), shape))
                frames[name].append(frame)
        if frame % VELOCITY_EVERY == 0:
            stacks["velocity"][-1][~_is_near_smoke(stacks["density"][-1])] = 0.0
    with whole_hdf5(target) as file:
        file.attrs["voxel_size"], file.attrs["origin"] = size, origin
        for name, stack in stacks.items():
            array = (np.rint(np.stack(stack) / _STEPS[name]) * _STEPS[name]).astype(np.float16)
            file.create_dataset(
                name, data=array, chunks=(1, *array.shape[1:]), compression="gzip", compression_opts=9, shuffle=True
            )
            file[f"{name}_frames"] = np.array(frames[name], np.int32)
    return {"file": VOLUMES_FILE, "voxel_size": size, "origin": list(origin), "shape": list(shape)} | {
        f"{name}_frames": found for name, found in frames.items()
    }


def _is_near_smoke(density: np.ndarray) -> np.ndarray:
    """[X, Y, Z] 1/m -> where there is smoke within two voxels."""
    return ndimage.binary_dilation(density > _FAINT, iterations=2)


def _placed(grid: DenseGrid, air: DenseGrid) -> np.ndarray:
    """The grid's values on the voxels of `air`, 0 where it has none."""
    shape = (*air.values.shape[:3], *grid.values.shape[3:])
    placed = np.zeros(shape, np.float32)
    steps = [(a - b) / air.voxel_size for a, b in zip(grid.origin, air.origin, strict=True)]
    start = [round(step) for step in steps]
    box = tuple(slice(begin, begin + length) for begin, length in zip(start, grid.values.shape[:3], strict=True))
    if max(abs(step - begin) for step, begin in zip(steps, start, strict=True)) > 1e-3 or placed[box].shape != grid.values.shape:
        raise ValueError("the grids of a simulation do not lie on the same voxels")
    placed[box] = grid.values
    return placed


def _coarse(values: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Means over blocks of 2 x 2 x 2; a rest at the far side is left out."""
    values = values[tuple(slice(0, size * _COARSER) for size in shape)]
    blocks = [part for size in shape for part in (size, _COARSER)]
    return values.reshape(*blocks, *values.shape[3:]).mean(axis=(1, 3, 5))


def _write_truth(
    scene: str,
    folder: Path,
    preset: Preset,
    target: Path,
    *,
    frames: dict[str, list[int]],
    volumes: dict[str, object],
) -> Path:
    path = target / TRUTH_FOLDER / TRUTH_FILE
    made = {
        str(file.relative_to(target).as_posix()): hashlib.sha256(file.read_bytes()).hexdigest()
        for file in sorted(target.rglob("*"))
        if file.is_file() and file != path
    }
    data = {
        **scene_facts(scene, folder, preset),
        "views": frames,
        "volumes": volumes,
        "units": {
            "density": "1/m extinction",
            "velocity": "m/s",
            "smoke": "8-bit: light premultiplied with opacity, sRGB-coded; 4th channel opacity, not coded",
            "cameras": "metres; axes x right, y down, z forward; world z up; pixel centres at +0.5",
        },
        "sha256": made,
    }
    with whole_file(path) as part:
        part.write_text(json.dumps(data, indent=2, sort_keys=True, allow_nan=False), encoding="utf-8")
    return path
