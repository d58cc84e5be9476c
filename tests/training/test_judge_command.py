"""Plumes are judged one by one; those that a file holds are not judged again."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
from made_plumes import ball, made_plume

from backend.prior.weights import WEIGHTS, weights_fingerprint
from training import judge_command
from training.library import Plume
from training.plumes import plume


def test_plumes_that_the_file_holds_are_not_judged_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("a", "b"):
        (tmp_path / "plumes" / name).mkdir(parents=True)
        (tmp_path / "plumes" / name / "plume.json").touch()
    read = {"a": plume(3), "b": plume(4)}
    monkeypatch.setattr(judge_command, "Prior", lambda weights: None)
    monkeypatch.setattr(judge_command, "read_plume", lambda folder: replace(made_plume(ball()), scene=read[folder.name]))
    file, asked = tmp_path / "found.json", []

    def judged(of: Plume, prior: object, config: object) -> dict[str, float]:
        asked.append(of.scene.name)
        if len(asked) == 2:
            raise KeyboardInterrupt
        return {"wind": 1.0}

    arguments = ["--plumes", str(tmp_path / "plumes"), "--json", str(file)]
    with pytest.raises(KeyboardInterrupt):
        judge_command.judge_all(arguments, judged, description=None, label="judge")
    assert judge_command.judge_all(arguments, judged, description=None, label="judge") == 0
    names = [scene.name for scene in read.values()]
    assert asked == [names[0], names[1], names[1]]
    found = json.loads(file.read_text())
    assert found == {"weights": weights_fingerprint(WEIGHTS)[:12], "preset": "draft", "plumes": {n: {"wind": 1.0} for n in names}}
    with pytest.raises(SystemExit):
        judge_command.judge_all([*arguments, "--preset", "final"], judged, description=None, label="judge")
