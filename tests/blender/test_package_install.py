"""The zip, installed through Blender's own operator in both wheels, with HOME at a temporary folder."""

from __future__ import annotations

import pytest

pytestmark = pytest.mark.blender
INSIDE = "inside_package.py"


def test_inside(passed):
    assert passed


def test_the_process_ends(wheel, finished_cleanly):
    assert finished_cleanly(wheel) is None
