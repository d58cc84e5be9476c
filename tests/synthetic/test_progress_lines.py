"""What a long run says."""

from __future__ import annotations

import pytest

from synthetic import progress as module
from synthetic.progress import Progress, duration


@pytest.mark.parametrize(("seconds", "text"), [(0, "0 s"), (89, "89 s"), (90, "1.5 min"), (5399, "90.0 min"), (7200, "2.0 h")])
def test_durations(seconds: float, text: str) -> None:
    assert duration(seconds) == text


def test_time_left_counts_only_what_this_run_made(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Ten steps, three done before; the first takes 100 s of warm-up, the next 20 s each, one is made by another worker."""
    now = [0.0]
    monkeypatch.setattr(module.time, "monotonic", lambda: now[0])
    progress = Progress(label="render", total=10, done=3)
    for seconds, is_made in ((100, True), (20, True), (0, False), (20, True)):
        now[0] += seconds
        progress.step(is_made=is_made)
    lines = capsys.readouterr().err.splitlines()
    assert lines == ["render: 4/10", "render: 5/10, 1.7 min left", "render: 7/10, 60 s left"]
