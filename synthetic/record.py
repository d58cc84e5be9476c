"""The steps that run in the backend's environment: `simulate` writes the smoke, `assemble` finishes a rendered scene, `pack`
makes the small set of it that ships."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from backend.contract.errors import EXIT_DONE, EXIT_USER, BackendError
from synthetic.assemble import assemble
from synthetic.plan import SMOKE_FOLDER
from synthetic.presets import PRESETS, Preset
from synthetic.progress import Progress
from synthetic.scenes import SCENES, SmokeScene
from synthetic.shipped import SHIPPED_FOLDER, pack
from synthetic.solver.recording import Recording, record


def recording_of(scene: SmokeScene, preset: Preset) -> Recording:
    """How a preset simulates a scene."""
    return Recording(
        scene=scene,
        num_frames=preset.num_frames,
        fps=preset.fps,
        voxel_size=preset.voxel_size,
        steps_per_frame=preset.steps_per_frame,
        velocity_every=preset.volumes_every,
    )


def main(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(prog="synth")
    parser.add_argument("step", choices=("simulate", "assemble", "pack"))
    parser.add_argument("scene")
    parser.add_argument("--out", type=Path, required=True, help="folder of this scene")
    parser.add_argument("--preset", choices=sorted(PRESETS), default="bench")
    parser.add_argument("--to", type=Path, default=SHIPPED_FOLDER, help="for pack: the folder that holds a folder of each scene")
    given = parser.parse_args(arguments)
    try:
        if given.scene not in SCENES:
            raise BackendError("unknown_scene", f'There is no scene "{given.scene}".', hint=f"Choose one of {', '.join(SCENES)}.")
        scene, preset = SCENES[given.scene], PRESETS[given.preset]
        if given.step == "assemble":
            print(assemble(given.scene, given.out, preset))
            return EXIT_DONE
        if given.step == "pack":
            print(pack(given.scene, given.out, preset, given.to / given.scene))
            return EXIT_DONE
        progress = Progress(label=f"simulate {scene.name}", total=preset.num_frames)
        record(recording_of(scene, preset), given.out / SMOKE_FOLDER, progress=progress.step)
    except BackendError as error:
        print(f"synthetic: {error}", file=sys.stderr)
        return EXIT_USER
    return EXIT_DONE


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
