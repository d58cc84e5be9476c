"""One clip for all of these tests."""

from __future__ import annotations

from pathlib import Path

import pytest
from small_job import draw_plume


@pytest.fixture(scope="session")
def plume(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return draw_plume(tmp_path_factory.mktemp("clip") / "plume")
