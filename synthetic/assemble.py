"""The last step of a scene: checks that every image is there, makes the clip, gathers the volumes, writes truth.json.

truth.json is written last: where it is, the scene is whole. Runs in the backend's environment.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from pathlib import Path

from backend.contract.errors import BackendError
from backend.contract.result import vdb_path
from backend.contract.truth import CLIP_VIDEO, INPUT_FOLDER, TRUTH_FILE, TRUTH_FOLDER
from backend.io.atomic import whole_file
from synthetic.clip import encode_clip
from synthetic.plan import SMOKE_FOLDER, TEST_VIEWS, Image, plan_images
from synthetic.presets import Preset
from synthetic.scenes import SCENES

VOLUME_NAME = "volume_{:04d}.vdb"  # numbered by video frame from 0
_FORMAT_VERSION = 1


def assemble(scene: str, folder: Path, preset: Preset) -> Path:
    """Make input/clip.mp4, truth/volumes and truth/truth.json of a rendered scene. Returns the path of the last."""
    check_rendered(plan_images(preset), folder, command="synth render")
    num_seen = preset.num_frames - preset.num_future
    clip = folder / INPUT_FOLDER / CLIP_VIDEO
    frames = [folder / INPUT_FOLDER / "clip" / f"{frame:04d}.png" for frame in range(num_seen)]
    encode_clip(frames, clip, fps=preset.fps)
    volume_frames = _gather_volumes(folder, preset)
    data = {
        **scene_facts(scene, folder, preset),
        "views": {name: TEST_VIEWS.get(name, 0.0) for name in preset.views},
        "smoke_every": preset.smoke_every,
        "volumes": {"frames": volume_frames, "name": VOLUME_NAME},
        "units": {
            "density": "1/m extinction",
            "velocity": "m/s",
            "temperature": "K above the air around",
            "depth": "m along the camera's axis, 0 where there is sky",
            "smoke": "smoke on black: light premultiplied with opacity, sRGB-coded, 16 bits; 4th channel opacity, not coded",
            "clip": "sRGB",
            "plate": "sRGB",
            "cameras": "metres; axes x right, y down, z forward; world z up; pixel centres at +0.5",
        },
    }
    path = folder / TRUTH_FOLDER / TRUTH_FILE
    with whole_file(path) as part:
        part.write_text(json.dumps(data, indent=2, sort_keys=True, allow_nan=False), encoding="utf-8")
    return path


def check_rendered(images: Sequence[Image], folder: Path, *, command: str) -> None:
    """Raises BackendError where images are missing; command: what makes them."""
    missing = [image.path for image in images if not (folder / image.path).exists()]
    if missing:
        raise BackendError(
            "images_missing",
            f"{len(missing)} images of {folder} are missing, the first is {missing[0]}.",
            hint=f"Run `{command}` with the same --out until all are there.",
        )


def scene_facts(scene: str, folder: Path, preset: Preset) -> dict[str, object]:
    """What every truth.json says: of the scene, its clip, its images and its simulation."""
    return {
        "format_version": _FORMAT_VERSION,
        "scene": scene,
        "purpose": SCENES[scene].purpose,
        "frames": {"count": preset.num_frames, "seen": preset.num_frames - preset.num_future, "fps": preset.fps},
        "size": [preset.width, preset.height],
        "render": json.loads((folder / "render.json").read_text(encoding="utf-8")),
        "simulation": _simulation(folder),
    }


def _gather_volumes(folder: Path, preset: Preset) -> list[int]:
    """Copy every volumes_every-th frame's VDB, which holds velocity too, next to the other truth."""
    target = folder / TRUTH_FOLDER / "volumes"
    target.mkdir(parents=True, exist_ok=True)
    frames = list(range(0, preset.num_frames, preset.volumes_every))
    if not (folder / SMOKE_FOLDER).is_dir():  # the user's own smoke: there is no velocity to keep
        return []
    for frame in frames:
        with whole_file(target / VOLUME_NAME.format(frame)) as part:
            shutil.copyfile(vdb_path(folder / SMOKE_FOLDER, frame), part)
    return frames


def _simulation(folder: Path) -> object:
    path = folder / SMOKE_FOLDER / "smoke.json"
    return json.loads(path.read_text(encoding="utf-8")) if path.exists() else None
