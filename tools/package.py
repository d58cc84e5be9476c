"""Builds dist/wildsmoke-<version>.zip, the extension that Blender installs. Standard library only.

What goes in: the manifest's own list (the "!" lines of paths_exclude_pattern), so that Blender's build command makes
the same zip; a test compares the two. The same tree gives the same bytes.
"""

from __future__ import annotations

import argparse
import fnmatch
import sys
import tomllib
import zipfile
from collections.abc import Iterator
from pathlib import Path

CHECKOUT = Path(__file__).resolve().parents[1]
MANIFEST = "blender_manifest.toml"
_FIXED_TIME = (1980, 1, 1, 0, 0, 0)  # of every entry: the zip's bytes depend on the files' contents alone
_FILE_MODE = 0o644 << 16


def main(argv: list[str]) -> int:
    """Build the zip and print its path."""
    parser = argparse.ArgumentParser(prog="wildsmoke.py package", description="Build the extension's zip.")
    parser.add_argument("--out", type=Path, default=CHECKOUT / "dist", help="folder for the zip (default: dist)")
    options = parser.parse_args(argv)
    path = build(CHECKOUT, options.out)
    print(f"{path} ({path.stat().st_size / 1024:.0f} KiB)")
    return 0


def build(root: Path, out: Path) -> Path:
    """Write the zip of the extension in `root` into the folder `out`, and give its path."""
    with open(root / MANIFEST, "rb") as handle:
        manifest = tomllib.load(handle)
    out.mkdir(parents=True, exist_ok=True)
    path = out / f"{manifest['id']}-{manifest['version']}.zip"
    part = path.with_name(path.name + ".part")
    with zipfile.ZipFile(part, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
        for file in packaged_files(root, manifest["build"]["paths_exclude_pattern"]):
            entry = zipfile.ZipInfo(file.relative_to(root).as_posix(), _FIXED_TIME)
            entry.compress_type = zipfile.ZIP_DEFLATED
            entry.external_attr = _FILE_MODE
            archive.writestr(entry, file.read_bytes())
    part.replace(path)
    return path


def packaged_files(root: Path, patterns: list[str]) -> list[Path]:
    """The files of the extension, sorted. Raises FileNotFoundError if something that the manifest names is missing."""
    kept = [pattern.removeprefix("!/") for pattern in patterns if pattern.startswith("!/")]
    excluded = [pattern.rstrip("/") for pattern in patterns if not pattern.startswith(("!", "/"))]
    files = [file for name in kept for file in _walk(root / name, excluded)]
    return sorted(files, key=lambda file: file.relative_to(root).as_posix())


def _walk(path: Path, excluded: list[str]) -> Iterator[Path]:
    if any(fnmatch.fnmatchcase(path.name, pattern) for pattern in excluded):
        return
    if path.is_dir():
        for child in sorted(path.iterdir()):
            yield from _walk(child, excluded)
    elif path.is_file():
        yield path
    else:
        raise FileNotFoundError(f"{path} is named in {MANIFEST} and is not there")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
