"""Names the checkout `wildsmoke` for the tests, whatever its folder is called."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pytest  # not at run time: the checks inside Blender's wheel read this file, too, and have no pytest

CHECKOUT = Path(__file__).resolve().parent

if str(CHECKOUT) not in sys.path:
    sys.path.insert(0, str(CHECKOUT))

import backend.kernel_setup  # noqa: E402, F401 before numba, whichever test imports it first

if "wildsmoke" not in sys.modules and (CHECKOUT / "__init__.py").exists():
    spec = importlib.util.spec_from_file_location(
        "wildsmoke", CHECKOUT / "__init__.py", submodule_search_locations=[str(CHECKOUT)]
    )
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["wildsmoke"] = module
    spec.loader.exec_module(module)


def pytest_configure() -> None:
    """No test of random examples fails because the machine was busy for a moment."""
    from hypothesis import settings  # not before: see above

    settings.register_profile("busy", deadline=None)
    settings.load_profile("busy")


def pytest_addoption(parser: pytest.Parser) -> None:
    """Here, because pytest asks only the topmost conftest for options."""
    group = parser.getgroup("extremes", "tests/extremes")
    group.addoption("--extremes", choices=("short", "full"), default="short", help="full: a million particles, 8K, long rollouts")
    group.addoption("--extremes-table", metavar="JSON", help="write what was tried and what was measured")
