"""The table of the extremes: each test says what it tried, how far it let things go, and how far they went.

pytest tests/extremes                                  what fits into two minutes
pytest tests/extremes --extremes=full                  the whole ranges: a million particles, 8K, long rollouts
pytest tests/extremes --extremes-table FILE.json       writes the table too, if nothing failed
"""

from __future__ import annotations

import json
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import numba
import numpy as np
import pytest


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """One line of the table. worst: the largest value that was measured; it may be at most `bound`."""

    part: str
    quantity: str
    tried: str
    happens: str
    measure: str
    bound: float
    worst: float
    test: str


class Table:
    """What one test adds to the table. is_full: whether the whole ranges are asked for."""

    def __init__(self, request: pytest.FixtureRequest, rows: list[Row]) -> None:
        self.is_full = request.config.getoption("--extremes") == "full"
        self._test = f"{Path(request.node.path).name}::{request.node.name}"
        self._part = request.module.PART
        self._rows = rows

    def row(self, quantity: str, *, tried: str, happens: str, measure: str, worst: float, bound: float) -> None:
        """Keep the line; fails where the worst value is beyond its bound, or is no number."""
        worst = float(worst)
        assert worst <= bound, f"{quantity}: {measure} is {worst:g}, beyond {bound:g}"
        self._rows.append(
            Row(
                part=self._part, quantity=quantity, tried=tried, happens=happens, measure=measure, bound=float(bound),
                worst=worst, test=self._test,
            )
        )  # fmt: skip


@pytest.fixture
def table(request: pytest.FixtureRequest) -> Table:
    return Table(request, request.config.stash.setdefault(_ROWS, []))


_ROWS = pytest.StashKey[list[Row]]()
_BEGAN = time.monotonic()


def pytest_sessionfinish(session: pytest.Session, exitstatus: int) -> None:
    target = session.config.getoption("--extremes-table")
    if target is None or exitstatus != 0:
        return
    data = {
        "command": "python -m tools.extremes_page",
        "range": session.config.getoption("--extremes"),
        "seconds": round(time.monotonic() - _BEGAN),
        "threads": numba.get_num_threads(),
        "versions": {"numpy": np.__version__, "numba": numba.__version__},
        "rows": [asdict(row) for row in session.config.stash.get(_ROWS, [])],
    }
    Path(target).write_text(json.dumps(data, indent=1, allow_nan=False) + "\n", encoding="utf-8")
