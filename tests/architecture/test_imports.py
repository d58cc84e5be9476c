"""Who may import whom. Reads the source, so that relative imports and imports inside functions count, too.

ruff bans the absolute ones while one writes; this test also sees the rest, and is itself tested below.
"""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

CHECKOUT = Path(__file__).resolve().parents[2]
BLENDER = frozenset(("bpy", "bpy_extras", "bmesh", "mathutils", "gpu", "blf", "addon_utils", "bl_ui", "openvdb"))
IMPORTERS = ("importlib.import_module", "import_module", "__import__")
OURS = frozenset(("addon", "backend", "synthetic", "training", "tools", "benchmarks", "tests", "wildsmoke"))


@dataclass(frozen=True)
class Import:
    """One import: the module in full, from the checkout's root; whether it was written relatively."""

    file: str
    line: int
    module: str
    is_relative: bool

    def is_of(self, *packages: str) -> bool:
        return any(self.module == package or self.module.startswith(package + ".") for package in packages)

    @property
    def top(self) -> str:
        return self.module.partition(".")[0]

    def __str__(self) -> str:
        return f"{self.file}:{self.line} imports {self.module}"


def imports_of(source: str, file: str) -> Iterator[Import]:
    """Every import of a file, also importlib.import_module("...") and __import__("...")."""
    package = file.split("/")[:-1]
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield Import(file, node.lineno, alias.name, False)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            module = [*base, *([node.module] if node.module else [])]
            for alias in node.names:  # `from . import x` and `from .a import x`: x may be a module
                yield Import(file, node.lineno, ".".join([*module, alias.name]), node.level > 0)
        elif isinstance(node, ast.Call) and ast.unparse(node.func) in IMPORTERS:
            for name in (word.value for word in node.args[:1] if isinstance(word, ast.Constant)):
                yield Import(file, node.lineno, name.lstrip("."), name.startswith("."))


def imports_in(folder: str) -> list[Import]:
    found = []
    for path in sorted((CHECKOUT / folder).rglob("*.py")):
        name = path.relative_to(CHECKOUT).as_posix()
        found += imports_of(path.read_text(encoding="utf-8"), name)
    return found


def addon_problem(found: Import) -> str | None:
    """The add-on: Blender's modules, numpy, the standard library, itself, and of the backend the contract; all relative."""
    if found.is_relative:
        allowed = found.is_of("addon", "backend.contract") or found.module == "backend.contract"
        return None if allowed else "of the backend only backend.contract"
    if found.top in OURS:
        return "inside the extension all imports are relative"
    if found.top in BLENDER or found.top == "numpy" or found.top in sys.stdlib_module_names:
        return None
    return "Blender does not bring it"


def backend_problem(found: Import) -> str | None:
    """The backend: never Blender, never the other houses; its parts keep their distance."""
    if found.top in BLENDER - {"openvdb"}:
        return "the backend never imports Blender"
    if found.is_of("addon", "synthetic", "training", "tools", "benchmarks", "tests", "wildsmoke"):
        return "the backend stands alone"
    where = found.file
    if where.startswith("backend/contract/"):
        is_own = found.is_of("backend.contract")
        return None if is_own or found.top in sys.stdlib_module_names else "the contract needs the standard library alone"
    if where.startswith("backend/stages/") and found.is_of("backend.stages"):
        return "stages never import each other"
    if where.startswith("backend/physics/") and found.is_of("backend.render"):
        return "physics never imports render"
    if where.startswith("backend/render/") and found.is_of("backend.physics"):
        return "render never imports physics"
    if where.startswith(("backend/field/", "backend/prior/")) and found.is_of("backend.fit", "backend.render", "backend.physics"):
        return "grids know nothing of particles"
    if found.is_of("backend.published") and not where.startswith(("backend/stages/", "backend/published/")):
        return "only the stages choose a method"
    parts = ("backend/physics/", "backend/render/", "backend/geometry/", "backend/fit/", "backend/published/", "backend/score/")
    if where.startswith(parts) and found.is_of("backend.stages"):
        return "the parts never import what is built of them"
    if where.count("/") > 1 and found.is_of("backend.pipeline"):
        return "only the command line, beside it, knows the pipeline"
    return None


def synthetic_problem(found: Import) -> str | None:
    """The truth is made without the code under test."""
    if found.is_of("backend.render", "backend.physics", "backend.fit", "backend.prior", "backend.stages", "training"):
        return "truth made by the code under test proves nothing"
    return None


RULES = {"addon": addon_problem, "backend": backend_problem, "synthetic": synthetic_problem}


@pytest.mark.parametrize("folder", list(RULES))
def test_import_directions(folder):
    problems = [f"{found}: {problem}" for found in imports_in(folder) if (problem := RULES[folder](found))]
    assert not problems, "\n".join(problems)


def test_the_entry_imports_nothing_at_the_top():
    tree = ast.parse((CHECKOUT / "__init__.py").read_text(encoding="utf-8"))
    top = [node for node in tree.body if isinstance(node, (ast.Import, ast.ImportFrom))]
    assert not top, "Blender's modules come with register(), so that the checkout can be imported without Blender"


def test_blender_and_torch_never_meet():
    for folder in RULES:
        tops: dict[str, set[str]] = {}
        for found in imports_in(folder):
            tops.setdefault(found.file, set()).add(found.top)
        meeting = [file for file, names in tops.items() if "bpy" in names and names & {"torch", "numba"}]
        assert not meeting


def problem_of(source: str, file: str) -> str | None:
    rule = RULES[file.partition("/")[0]]
    return next((problem for found in imports_of(source, file) if (problem := rule(found))), None)


@pytest.mark.parametrize(
    ("source", "file"),
    [
        ("import torch", "addon/panel.py"),
        ("import h5py", "addon/panel.py"),
        ("from backend.contract import job", "addon/panel.py"),
        ("import wildsmoke.addon", "addon/panel.py"),
        ("from ..backend import pipeline", "addon/panel.py"),
        ("from .. import backend", "addon/panel.py"),
        ("from ...backend.io import vdb", "addon/scene/volume.py"),
        ("def f():\n    from ..backend.fit import state", "addon/panel.py"),
        ("import importlib\nimportlib.import_module('torch')", "addon/panel.py"),
        ("import bpy", "backend/stages/frames.py"),
        ("from addon import panel", "backend/stages/frames.py"),
        ("import numpy", "backend/contract/job.py"),
        ("from ..io import vdb", "backend/contract/job.py"),
        ("from . import visual", "backend/stages/frames.py"),
        ("from .visual import run", "backend/stages/frames.py"),
        ("from backend.stages.visual import run", "backend/stages/frames.py"),
        ("from ..render import splat", "backend/physics/kernels.py"),
        ("import backend.physics.kernels", "backend/render/splat.py"),
        ("from backend.stages import visual", "backend/render/splat.py"),
        ("from backend.published import visual", "backend/fit/scene.py"),
        ("from backend.stages import visual", "backend/published/visual.py"),
        ("from backend.pipeline import Pipeline", "backend/fit/scene.py"),
        ("from training import train", "backend/prior/network.py"),
        ("from backend.fit import scene", "backend/prior/window.py"),
        ("from backend.prior import network", "synthetic/solver/simulation.py"),
        ("from backend.render import splat", "synthetic/render.py"),
        ("from ..backend import physics", "synthetic/render.py"),
    ],
)
def test_each_forbidden_import_is_seen(source, file):
    assert problem_of(source, file) is not None


@pytest.mark.parametrize(
    ("source", "file"),
    [
        ("import bpy\nimport numpy as np\nimport os.path", "addon/panel.py"),
        ("from . import session\nfrom .settings import job_folder", "addon/panel.py"),
        ("from ..backend.contract import job\nfrom ..backend.contract.job import Job", "addon/panel.py"),
        ("from ...backend.contract.result import read_result", "addon/scene/volume.py"),
        ("import torch\nfrom backend.contract.errors import BackendError", "backend/stages/frames.py"),
        ("from .errors import BackendError\nimport json", "backend/contract/job.py"),
        ("from backend.published import visual", "backend/stages/visual.py"),
        ("from backend.stages import visual", "backend/pipeline.py"),
        ("from backend.pipeline import run", "backend/__main__.py"),
        ("import bpy\nfrom backend.contract import cameras", "synthetic/render.py"),
    ],
)
def test_each_allowed_import_passes(source, file):
    assert problem_of(source, file) is None
