"""The operators, the panel and the handlers inside Blender's wheels."""

from __future__ import annotations

import pytest

pytestmark = pytest.mark.blender
INSIDE = "inside_operators.py"


def test_inside(passed):
    assert passed


def test_the_process_ends(wheel, finished_cleanly):
    assert finished_cleanly(wheel) is None
