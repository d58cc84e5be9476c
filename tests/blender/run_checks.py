"""Inside Blender's wheel: run every check_* function of a file and write how each one ended.

Called as `python run_checks.py inside_x.py out.json`. Standard library and bpy only.
"""

from __future__ import annotations

import importlib.util
import json
import sys
import tempfile
import unittest
from collections.abc import Callable
from pathlib import Path

CHECKOUT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(CHECKOUT))

import bpy  # noqa: E402

import conftest  # noqa: E402, F401  (names the checkout `wildsmoke`)


def main(script: Path, out: Path) -> int:
    spec = importlib.util.spec_from_file_location(script.stem, script)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    report: dict[str, str | None] = {}
    for name, check in list(vars(module).items()):
        if not name.startswith("check_"):
            continue
        bpy.ops.wm.read_homefile(use_factory_startup=True, use_empty=True)
        with tempfile.TemporaryDirectory() as folder:
            report[name] = problem_of(check, Path(folder))
        out.write_text(json.dumps(report))
    return 0


def problem_of(check: Callable[[Path], None], folder: Path) -> str | None:
    """The traceback of a failure of any kind, None if there is none."""

    def run() -> None:
        check(folder)

    result = unittest.TestResult()
    unittest.FunctionTestCase(run).run(result)
    return next((text for _, text in result.failures + result.errors), None)


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]), Path(sys.argv[2])))
