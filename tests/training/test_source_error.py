"""How far off sources are found in plumes of a library."""

from __future__ import annotations

import json
from pathlib import Path

from training.library import Plume
from training.source_error import main, source_errors, summary


def test_a_plume_has_two_errors(recorded: Plume) -> None:
    parts = source_errors(recorded)
    assert parts == source_errors(recorded)
    found = parts["whole"]
    assert found["turned"] > parts["first half"]["turned"] > parts["first quarter"]["turned"] > 0.0
    assert found["sources"] == len(recorded.scene.sources)
    assert 0.0 <= found["source"] < 2.0


def test_kinds_are_told_apart() -> None:
    rows = [
        {"sources": 1, "wind": 0.1, "foot": 0.2, "source": 0.1},
        {"sources": 2, "wind": 1.5, "foot": 2.0, "source": 0.3},
        {"sources": 1, "wind": 1.0, "foot": 3.0, "source": 1.2},
    ]
    found = summary(rows)
    assert {kind: line["clips"] for kind, line in found.items()} == {"all": 3, "windy": 2, "calm": 1, "one source": 2, "more": 1}
    assert found["windy"]["foot, median"] == 2.5
    assert found["windy"]["source, beyond 1 m"] == 0.5
    assert found["all"]["source, median"] == 0.3
    assert found["calm"]["foot, mean"] == 0.2
    assert "foot, median" not in summary([])["all"]


def test_a_file_holds_every_plume(folder: Path, tmp_path: Path) -> None:
    assert main(["--plumes", str(folder.parent), "--json", str(tmp_path / "errors.json")]) == 0
    result = json.loads((tmp_path / "errors.json").read_text(encoding="utf-8"))
    assert result["plumes"].keys() >= {folder.name}
