"""What docs/prior.md says of the training is what the training wrote, of the weights that ship."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from backend.geometry.camera import view_at
from backend.prior.weights import WEIGHTS, weights_fingerprint
from backend.prior.window import away_of
from training.judge import standing
from training.judge_still import WAYS
from training.plumes import plume as scene_of

CHECKOUT = Path(__file__).resolve().parents[2]
JUDGED = ("density", "sideways", "up", "depth", "level_m", "nvs_last_db", "side_db")
COLUMNS = ("density1", "density2", "sideways2", "up2", "depth2")


@pytest.mark.parametrize(
    ("name", "lines"),
    [
        ("prior_training", 8),
        ("prior_training_on", 4),
        ("prior_training_wind", 5),
        ("prior_training_short", 5),
        ("prior_training_found", 4),  # and one for what was started from
        ("prior_training_fine", 4),  # the same
        ("prior_training_still", 5),  # the same
    ],
)
def test_the_page_shows_the_log_of_the_training(name: str, lines: int) -> None:
    page = (CHECKOUT / "docs" / "prior.md").read_text(encoding="utf-8")
    assert f"docs/results/{name}.jsonl" in page
    log = (CHECKOUT / "docs" / "results" / f"{name}.jsonl").read_text(encoding="utf-8").splitlines()
    assert len(log) == lines
    for line in log:
        entry = json.loads(line)
        cells = " | ".join(f"{entry[name]:.3f}" for name in COLUMNS)
        assert f"| {entry['passes']} | {cells} |" in page


def test_the_page_shows_the_log_of_the_network_of_levels() -> None:
    page = (CHECKOUT / "docs" / "prior.md").read_text(encoding="utf-8")
    log = (CHECKOUT / "docs" / "results" / "prior_levels.jsonl").read_text(encoding="utf-8").splitlines()
    entries = [json.loads(line) for line in log]
    assert len(entries) == 120  # twenty of each training
    for number, name in enumerate(("first", "second", "third", "fourth", "fifth", "sixth")):
        training = entries[20 * number : 20 * (number + 1)]
        for entry in training[3::4]:
            cells = " | ".join(
                f"{value:.2f}" for value in (entry["taught"][0], *(entry[key] for key in ("rms", "middle", "median")))
            )
            assert f"| {name} | {entry['steps']} | {cells} |" in page


def test_the_page_shows_the_log_of_the_network_of_shares() -> None:
    page = (CHECKOUT / "docs" / "prior.md").read_text(encoding="utf-8")
    log = (CHECKOUT / "docs" / "results" / "prior_shares.jsonl").read_text(encoding="utf-8").splitlines()
    entries = [json.loads(line) for line in log]
    assert len(entries) == 11  # what was started from, and ten
    for entry in entries[::2]:
        views = " | ".join(f"{entry[name]:.2f}" for name in ("side_db", "between_db"))
        assert f"| {entry['steps']} | {entry['density']:.3f} | {entry['space']:.3f} | {views} |" in page


def test_the_page_shows_how_right_the_volumes_are() -> None:
    page = (CHECKOUT / "docs" / "prior.md").read_text(encoding="utf-8")
    results = json.loads((CHECKOUT / "docs" / "results" / "prior_volumes.json").read_text(encoding="utf-8"))
    assert results["weights"] == weights_fingerprint()[:12]
    plumes = results["plumes"].values()
    for way in ("by the pictures", "by the prior", "particles"):
        for name, those in (
            ("all", list(plumes)),
            ("calm", [plume for plume in plumes if plume["wind"] < 0.8]),
            ("windy", [plume for plume in plumes if plume["wind"] >= 0.8]),
        ):
            known = those[0][way]
            means = {key: sum(plume[way][key] for plume in those) / len(those) for key in JUDGED if key in known}
            cells = " | ".join(f"{means[key]:.2f}" if key in known else "-" for key in JUDGED)
            assert f"| {way} | {name}, {len(those)} | {cells} |" in page


def test_the_page_shows_where_smoke_rises_from() -> None:
    page = (CHECKOUT / "docs" / "prior.md").read_text(encoding="utf-8")
    results = json.loads((CHECKOUT / "docs" / "results" / "source_errors.json").read_text(encoding="utf-8"))
    for group, kinds in results["summary"].items():
        for wind in ("windy", "calm"):
            found = kinds[wind]
            cells = " | ".join(f"{found[f'{way}, {what}']:.2f}" for way in ("foot", "source") for what in ("mean", "median"))
            assert f"| {group} | {wind} | {found['clips']} | {cells} |" in page


def test_the_page_shows_how_far_off_the_sources_of_short_clips_are() -> None:
    page = (CHECKOUT / "docs" / "prior.md").read_text(encoding="utf-8")
    results = json.loads((CHECKOUT / "docs" / "results" / "source_errors_short.json").read_text(encoding="utf-8"))
    for group, kinds in results["summary"].items():
        if group.startswith("parts, camera goes "):
            title = group.removeprefix("parts, camera goes ").removesuffix(" around").replace("further", "more")
            found = kinds["all"]
            (line,) = (line for line in page.splitlines() if line.startswith(f"| {title} | {found['clips']} | "))
            cells = line.split(" | ")
            assert float(cells[2]) == pytest.approx(found["foot, mean"], abs=0.006)
            assert float(cells[4]) == pytest.approx(found["source, mean"], abs=0.006)
            assert cells[6] == f"{100 * found['source, beyond 1 m']:.0f} % |"


def test_the_page_shows_what_is_made_of_a_still_camera() -> None:
    page = (CHECKOUT / "docs" / "prior.md").read_text(encoding="utf-8")
    results = json.loads((CHECKOUT / "docs" / "results" / "still_volumes.json").read_text(encoding="utf-8"))
    assert results["weights"] == weights_fingerprint()[:12]
    tuned = set(results["tuned_on"])
    for title, names in (("tuned on", tuned), ("not tuned on", set(results["plumes"]) - tuned)):
        for way in WAYS:
            rows = [results["plumes"][name][way] for name in sorted(names)]
            digits = {"density": 3, "sideways": 2, "up": 2, "depth": 2, "turned_30_db": 2, "side_db": 2, "back_db": 2}
            cells = " | ".join(f"{np.mean([row[key] for row in rows]):.{count}f}" for key, count in digits.items())
            assert f"| {way} | {title}, {len(rows)} | {cells} |" in page


def test_the_page_shows_what_wind_does_before_a_still_camera() -> None:
    """The figures of today, the last of three in each cell."""
    page = (CHECKOUT / "docs" / "prior.md").read_text(encoding="utf-8")
    plumes = json.loads((CHECKOUT / "docs" / "results" / "still_volumes.json").read_text(encoding="utf-8"))["plumes"]
    away = away_of(view_at(standing(0.0), 0))[:2]
    winds = {name: float(away @ scene_of(int(name.removeprefix("plume_"))).wind) for name in plumes}
    groups = {
        "0.8 m/s and more": (0.8, np.inf),
        "0.3 to 0.8": (0.3, 0.8),
        "less than 0.3 either way": (-0.3, 0.3),
        "0.3 and more towards it": (-np.inf, -0.3),
    }
    for title, (least, most) in groups.items():
        rows = [plumes[name]["as deep as wide"] for name, wind in winds.items() if least <= wind < most]
        density, turned, side = (np.mean([row[key] for row in rows]) for key in ("density", "turned_30_db", "side_db"))
        (line,) = (line for line in page.splitlines() if line.startswith(f"| {title} | {len(rows)} | "))
        today = [cell.split(",")[-1].strip() for cell in line.strip("| ").split(" | ")[2:]]
        assert today == [f"{density:.3f}", f"{turned:.1f}", f"{side:.1f}"]


def test_the_page_shows_what_levels_cost() -> None:
    page = (CHECKOUT / "docs" / "prior.md").read_text(encoding="utf-8")
    results = json.loads((CHECKOUT / "docs" / "results" / "depth_levels.json").read_text(encoding="utf-8"))
    assert results["weights"] == weights_fingerprint()[:12]
    for scene, ways in results["scenes"].items():
        for way, found in ways.items():
            assert f"| {scene} | {way} | {found['density']:.3f} | {found['nvs_last_db']:.2f} | {found['side_db']:.2f} |" in page


def test_the_weights_are_small() -> None:
    assert WEIGHTS.stat().st_size < 10_000_000
