"""The command line of the benchmark. Each step runs in the environment it needs, started from here.

    python3 wildsmoke.py synth list                                    scenes and presets
    python3 wildsmoke.py synth make SCENE --out DIR [--preset bench]   simulate, render and assemble, one after the other
    python3 wildsmoke.py synth simulate SCENE --out DIR [--preset bench]
    python3 wildsmoke.py synth render SCENE --out DIR [--preset bench] [--frames A:B] [--views ...] [--smoke DIR] ...
    python3 wildsmoke.py synth assemble SCENE --out DIR [--preset bench]
    python3 wildsmoke.py synth ship SCENE --out DIR [--to DIR]         the small set of a scene that ships in synthetic/bench
    python3 wildsmoke.py synth pack SCENE --out DIR [--to DIR]         its last step, from a scene that is rendered
    python3 wildsmoke.py synth demo --out DIR                          the bundled clip and its truth

Every step goes on where it was interrupted. The Pythons are .venv/backend and .venv/blender of the checkout;
--backend-python and --blender-python name others.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from pathlib import Path

from backend.contract.errors import EXIT_DONE, EXIT_USER, BackendError
from synthetic.presets import PRESETS
from synthetic.scenes import SCENES

_CHECKOUT = Path(__file__).resolve().parents[1]


def main(arguments: list[str]) -> int:
    if not arguments or arguments[0] in ("-h", "--help"):
        print(__doc__)
        return EXIT_DONE
    parser = argparse.ArgumentParser(prog="synth", add_help=False)
    parser.add_argument("--backend-python", type=Path, default=_python("backend"))
    parser.add_argument("--blender-python", type=Path, default=_python("blender"))
    pythons, rest = parser.parse_known_args(arguments)
    command, rest = rest[0], rest[1:]
    try:
        if command == "list":
            return _list()
        if command == "render":
            return _run(pythons.blender_python, "synthetic.render", rest)
        if command in ("simulate", "assemble", "pack"):
            return _run(pythons.backend_python, "synthetic.record", [command, *rest])
        if command == "make":
            return _make(pythons, rest)
        if command == "demo":
            return _make(pythons, ["demo", "--preset", "demo", *rest])
        if command == "ship":
            return _ship(pythons, rest)
        raise BackendError("unknown_command", f'There is no command "{command}".', hint="See `synth --help`.")
    except BackendError as error:
        print(f"synthetic: {error}", file=sys.stderr)
        return EXIT_USER


def _list() -> int:
    for scene in SCENES.values():
        print(f"{scene.name:<16} {scene.purpose}")
    print()
    for name, preset in PRESETS.items():
        print(
            f"{name:<16} {preset.width}x{preset.height}, {preset.num_frames} frames at {preset.fps:g} a second, "
            f"{preset.num_future} of them unseen, {preset.quality.samples} samples, voxels of {preset.voxel_size:g} m"
        )
    return EXIT_DONE


def _make(pythons: argparse.Namespace, arguments: list[str]) -> int:
    """The three steps; stops at the first that fails."""
    parser = argparse.ArgumentParser(prog="synth make", description="Simulate, render and assemble a scene.")
    parser.add_argument("scene")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--preset", choices=sorted(PRESETS), default="bench")
    given = parser.parse_args(arguments)
    common = [given.scene, "--out", str(given.out), "--preset", given.preset]
    return _in_turn(
        (pythons.backend_python, "synthetic.record", ["simulate", *common]),
        (pythons.blender_python, "synthetic.render", common),
        (pythons.backend_python, "synthetic.record", ["assemble", *common]),
    )


def _ship(pythons: argparse.Namespace, arguments: list[str]) -> int:
    """As _make, but only what ships is rendered, and packed in the end."""
    parser = argparse.ArgumentParser(prog="synth ship", description="Simulate, render and pack what ships of a scene.")
    parser.add_argument("scene")
    parser.add_argument("--out", type=Path, required=True, help="where the images lie while they are made")
    parser.add_argument("--preset", choices=sorted(PRESETS), default="bench")
    parser.add_argument("--to", type=Path, help="the folder that holds a folder of each scene, by default synthetic/bench")
    given = parser.parse_args(arguments)
    common = [given.scene, "--out", str(given.out), "--preset", given.preset]
    target = ["--to", str(given.to)] if given.to else []
    return _in_turn(
        (pythons.backend_python, "synthetic.record", ["simulate", *common]),
        (pythons.blender_python, "synthetic.render", [*common, "--shipped"]),
        (pythons.backend_python, "synthetic.record", ["pack", *common, *target]),
    )


def _in_turn(*steps: tuple[Path, str, list[str]]) -> int:
    """The exit code of the first step that fails."""
    for python, module, arguments in steps:
        code = _run(python, module, arguments)
        if code != EXIT_DONE:
            return code
    return EXIT_DONE


def _python(environment: str) -> Path:
    """The interpreter of one of the checkout's environments."""
    place = "Scripts/python.exe" if os.name == "nt" else "bin/python"
    return _CHECKOUT / ".venv" / environment / place


def _run(python: Path, module: str, arguments: list[str]) -> int:
    """Run a module of ours under another Python. Raises BackendError where there is none."""
    if not python.exists():
        raise BackendError(
            "python_missing",
            f"There is no Python at {python}.",
            hint="Run `python3 wildsmoke.py synth ...`, which sets it up, or name one with --backend-python or --blender-python.",
        )
    environment = dict(os.environ)
    environment["PYTHONPATH"] = os.pathsep.join(filter(None, [str(_CHECKOUT), environment.get("PYTHONPATH")]))
    return subprocess.run([str(python), "-m", module, *arguments], env=environment, check=False).returncode


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
