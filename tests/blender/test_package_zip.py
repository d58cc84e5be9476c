"""The extension's zip: what is in it, that Blender's own tool makes the same, and that it finds nothing wrong."""

from __future__ import annotations

import re
import shutil
import subprocess
import tomllib
import zipfile
from pathlib import Path

import pytest

from tools import package

CHECKOUT = Path(package.__file__).resolve().parents[1]
WEIGHTS = "backend/prior/plumes.npz"  # of the trained prior


@pytest.fixture(scope="module")
def archive(tmp_path_factory) -> Path:
    return package.build(CHECKOUT, tmp_path_factory.mktemp("dist"))


def names(path: Path) -> set[str]:
    with zipfile.ZipFile(path) as opened:
        return {name for name in opened.namelist() if not name.endswith("/")}


def extension_tool(python: Path) -> Path:
    (found,) = python.parents[1].glob("lib/python*/site-packages/bpy/*/scripts/addons_core/bl_pkg/cli/blender_ext.py")
    return found


@pytest.mark.blender
def test_blenders_tool_finds_nothing_wrong(archive, wheel, find_wheel_python):
    python = find_wheel_python(wheel)
    command = [str(python), str(extension_tool(python)), "validate", str(archive)]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert ended.returncode == 0 and "Success" in ended.stdout, ended.stdout + ended.stderr
    assert "warning" not in (ended.stdout + ended.stderr).lower()


@pytest.mark.blender
def test_blenders_tool_builds_the_same(archive, wheel, find_wheel_python, tmp_path):
    python = find_wheel_python(wheel)
    source = tmp_path / "checkout"
    shutil.copytree(CHECKOUT, source, ignore=shutil.ignore_patterns(".venv", ".git", "out", "dist"))
    (source / ".venv").mkdir()
    (source / ".venv" / "pyvenv.cfg").write_text("")
    built = tmp_path / "built.zip"
    command = [str(python), str(extension_tool(python)), "build", "--source-dir", str(source), "--output-filepath", str(built)]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    # other work may go on in the checkout meanwhile: compare with a zip of the same copy
    assert names(built) == names(package.build(source, tmp_path))


def test_it_holds_what_it_needs_and_nothing_else(archive):
    inside = names(archive)
    assert {"__init__.py", "blender_manifest.toml", "LICENSE", "addon/__init__.py", "backend/requirements.txt"} <= inside
    assert "backend/contract/events.py" in inside
    assert {name.partition("/")[0] for name in inside} == {"__init__.py", "blender_manifest.toml", "LICENSE", "addon", "backend"}
    unwanted = re.compile(r"(^|/)(tests?|docs|synthetic|benchmarks|tools|__pycache__|\..*|ruff\.toml|.*\.(pyc|part|md))(/|$)")
    assert not [name for name in inside if unwanted.search(name)]
    with zipfile.ZipFile(archive) as opened:
        sizes = {entry.filename: entry.compress_size for entry in opened.infolist()}
    assert sizes.pop(WEIGHTS, 0) < 10.5e6
    assert sum(sizes.values()) < 5e6


def test_it_carries_the_weights_of_the_prior(archive, tmp_path):
    with zipfile.ZipFile(archive) as opened:
        opened.extractall(tmp_path / "tree")
    (tmp_path / "tree" / WEIGHTS).write_bytes(b"some weights")
    with zipfile.ZipFile(package.build(tmp_path / "tree", tmp_path)) as opened:
        assert opened.read(WEIGHTS) == b"some weights"


def test_the_same_files_give_the_same_bytes(archive, tmp_path):
    for number in (1, 2):
        with zipfile.ZipFile(archive) as opened:
            opened.extractall(tmp_path / f"tree{number}")
    first, second = (package.build(tmp_path / f"tree{n}", tmp_path / f"dist{n}") for n in (1, 2))
    assert first.read_bytes() == second.read_bytes() == archive.read_bytes()


def test_what_the_manifest_names_must_be_there(tmp_path):
    shutil.copy(CHECKOUT / "blender_manifest.toml", tmp_path)
    with pytest.raises(FileNotFoundError, match=r"__init__\.py"):
        package.build(tmp_path, tmp_path / "dist")


def test_the_manifest_agrees_with_the_project():
    manifest = tomllib.loads((CHECKOUT / "blender_manifest.toml").read_text(encoding="utf-8"))
    project = tomllib.loads((CHECKOUT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    version = re.search(r'__version__ = "(.+)"', (CHECKOUT / "backend/__init__.py").read_text())[1]
    assert manifest["version"] == project["version"] == version
    assert manifest["license"] == [f"SPDX:{project['license']}"]
    assert manifest["blender_version_min"] == "4.5.0"
    assert all(len(text) <= 64 and not text.endswith(".") for text in manifest["permissions"].values())
    assert len(manifest["tagline"]) <= 64
    assert "GNU GENERAL PUBLIC LICENSE" in (CHECKOUT / "LICENSE").read_text()[:200]


def test_the_shipped_requirements_are_the_projects():
    project = tomllib.loads((CHECKOUT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    lines = (CHECKOUT / "backend/requirements.txt").read_text().splitlines()
    assert [line for line in lines if not line.startswith("#")] == project["dependencies"]


def test_the_command_prints_where_it_is(tmp_path, capsys):
    assert package.main(["--out", str(tmp_path)]) == 0
    assert re.match(r".*wildsmoke-\d+\.\d+\.\d+\.zip \(\d+ KiB\)\n", capsys.readouterr().out)
