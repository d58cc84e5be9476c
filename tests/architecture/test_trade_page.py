"""docs/trade.md is what docs/results/trade.json says, and no preset is beaten by something that was measured."""

from __future__ import annotations

import copy
import math
import re
from dataclasses import asdict
from typing import Any

import pytest

from backend.contract.job import PRESETS, preset_config
from benchmarks import trade_front as front
from benchmarks.reconstruction import UNTOUCHED
from benchmarks.trade import with_shared_costs
from benchmarks.trade_plan import FRAMES, Trial, compared, sweeps, with_donors
from tools import trade_page

SCORES = {"nvs_db": 24.0, "side_db": 20.0, "input_smoke_db": 33.0, "vdb_opacity_db": 30.0, "density_correlation": 0.7}


def results() -> dict[str, Any]:
    return trade_page.read()[0]


def cell(name: str, cost: float = 20.0, *, scene: str = "a", seed: int = 0, **scores: float) -> dict[str, Any]:
    """A cell as bench writes it; a name with "=" is a change of the preset named first."""
    preset, *changes = name.split()
    stages = {"visual": {"cpu_seconds": 0.5 * cost, "seconds": cost, "peak_gib": 0.5, "is_taken_over": False}}
    return {
        "scene": scene, "name": name, "preset": preset, "changes": [change.split("=") for change in changes], "seed": seed,
        "frames": [75, 105], "scored_from": 75, "threads": 1, "repeat": 0, "load": 1.0, "code": "c0de", "weights": "w",
        "stages": stages, "seconds": 2.0 * cost, "cpu_seconds": cost, "peak_gib": 0.6, "scores": SCORES | scores,
    }  # fmt: skip


# Presets that were found to be beaten and wait for better settings; strict, so that they are taken off here once they have them.
NOISE = {"unseen_db": 0.01, "input_smoke_db": 0.01, "vdb_opacity_db": 0.01, "density_correlation": 0.0001, front.COST: 0.001}


def point(name: str, *cells: dict[str, Any]) -> front.Point:
    return front.Point(name=name, cells={each["scene"]: each for each in cells})


def test_the_page_agrees_with_its_figures() -> None:
    assert trade_page.PAGE.read_text(encoding="utf-8") == trade_page.page(*trade_page.read())


def test_the_pictures_of_the_page_are_there_and_small() -> None:
    names = re.findall(r"!\[[^]]*\]\(([^)]+)\)", trade_page.page(*trade_page.read()))
    assert len(names) == 2
    for name in names:
        assert (trade_page.PAGE.parent / name).stat().st_size < 400_000, name


def test_nothing_is_chosen_by_what_is_untouched_nor_compared_across_sources() -> None:
    cells = results()["cells"]
    assert not {found["scene"] for found in cells} & set(UNTOUCHED)
    assert len({(found["code"], found["weights"]) for found in cells}) == 1
    assert len({found["scene"] for found in cells}) >= 2


def beaten(name: str) -> list[str]:
    found = results()
    points = trade_page.whole(found)
    return [
        other.name for other in front.dominating(points[name], trade_page.rivals(name, points), front.noise_of(found["cells"]))
    ]


@pytest.mark.parametrize("name", PRESETS)
def test_no_preset_is_dominated(name: str) -> None:
    """A preset is a promise: nothing that was measured is nowhere worse and somewhere better, by more than noise."""
    assert not beaten(name)


def test_the_measured_presets_are_those_that_ship() -> None:
    """Else the front says nothing of them: run `bench` again after a preset was changed."""
    found = results()
    keys = [sweep["key"].split(".") for sweep in found["sweeps"] if "." in sweep["key"]]
    for name in PRESETS:
        shipped = asdict(preset_config(name))
        for section, key in keys:
            assert found["settings"][name][section][key] == shipped[section][key], f"{name}: {section}.{key}"


def test_noise_is_that_of_repeats_alone() -> None:
    repeats = [cell("draft", 20.0, seed=0, nvs_db=24.0), cell("draft", 20.0, seed=1, nvs_db=24.4)]
    others = [cell("final", 60.0), cell("draft visual.iterations=1", nvs_db=10.0)]
    found = front.noise_of([*repeats, *others])
    assert found["unseen_db"] == pytest.approx(0.2 / math.sqrt(2.0))  # the mean of NVS and side moves by 0.2
    assert found["input_smoke_db"] == found[front.COST] == 0.0
    with pytest.raises(ValueError, match="measured twice"):
        front.noise_of(others)


@pytest.mark.parametrize(
    ("changed", "cost", "expected"),
    [
        ({}, 20.0, False),  # the same is no better
        ({}, 15.0, True),  # cheaper and as good
        ({}, 19.8, False),  # by less than anyone would choose a setting for
        ({"nvs_db": 24.5}, 20.0, True),
        ({"nvs_db": 24.5}, 22.0, False),  # better but dearer
        ({"nvs_db": 23.5}, 10.0, False),  # cheaper but worse
        ({"nvs_db": 23.9}, 10.0, True),  # worse by 0.05 dB in the mean of NVS and side: nobody would see it
        ({"input_smoke_db": 34.0, "density_correlation": 0.68}, 20.0, False),  # better here, worse there
        ({"density_correlation": 0.71}, 20.0, True),
        ({"vdb_opacity_db": 28.0}, 15.0, False),  # cheaper, with coarser volumes
    ],
)
def test_who_dominates(changed: dict[str, float], cost: float, expected: bool) -> None:
    other = point("draft x=1", cell("draft x=1", cost, **changed))
    base = point("draft", cell("draft"))
    assert front.dominates(other, base, NOISE) is expected
    assert not front.dominates(base, base, NOISE)
    assert [found.name for found in front.dominating(base, [base, other], NOISE)] == (["draft x=1"] if expected else [])


def test_a_preset_that_lets_the_clip_decide_is_no_rival_of_itself() -> None:
    names = ("draft", "draft follow_clip=true", "preview follow_clip=true")
    points = {name: point(name, cell(name)) for name in names}
    assert [found.name for found in trade_page.rivals("draft", points)] == ["draft", "preview follow_clip=true"]


def test_noise_takes_the_edge_off() -> None:
    better, base = point("b", cell("b", nvs_db=25.0)), point("a", cell("a"))
    assert front.dominates(better, base, NOISE)
    assert not front.dominates(better, base, NOISE | {"unseen_db": 0.3})  # 0.5 dB in the mean, two standard errors are 0.85


def test_scenes_are_compared_pair_by_pair() -> None:
    base = point("a", cell("a", scene="x", nvs_db=30.0), cell("a", scene="y", nvs_db=20.0))
    partial = point("b", cell("b", scene="x", nvs_db=31.0))
    assert front.gains(partial, base, NOISE)["unseen_db"] > 1.0, "against the same scene"
    assert front.dominating(base, [partial], NOISE) == [], "one scene is not enough to say so"


def test_the_front_by_hand() -> None:
    points = [
        point(name, cell(name, cost, nvs_db=db)) for name, cost, db in (("a", 1, 20), ("b", 2, 19), ("c", 3, 25), ("d", 4, 25))
    ]
    assert [found.name for found in front.front(points, "unseen_db")] == ["a", "c"]


def test_growth_by_hand() -> None:
    exact = front.growth((scene, x, factor * x**1.5) for scene, factor in (("a", 2.0), ("b", 7.0)) for x in (1.0, 2.0, 8.0))
    assert exact is not None and exact.exponent == pytest.approx(1.5) and exact.error == pytest.approx(0.0, abs=1e-9)
    crooked = front.growth([("a", 1.0, 1.0), ("a", math.e, math.e), ("a", math.e**2, 1.0)])
    assert crooked is not None and crooked.exponent == pytest.approx(0.0)
    assert crooked.error == pytest.approx(math.sqrt((2.0 / 3.0) / 1.0 / 2.0))  # residuals -1/3, 2/3, -1/3; one degree of freedom
    assert front.growth([("a", 1.0, 1.0), ("a", 2.0, 2.0)]) is None, "two points fit any power"
    assert front.growth([("a", 0.0, 1.0), ("a", 1.0, 1.0), ("a", 2.0, 2.0)]) is None, "zero says nothing"
    assert front.growth([("a", 1.0, 1.0)] * 5) is None
    alone = front.growth([("a", 1.0, 1.0), ("a", 2.0, 2.0), ("a", 4.0, 4.0), ("b", 2.0, 9.0)])
    assert alone is not None and alone.count == 3, "a scene with one value says nothing of growth"


def test_the_page_says_who_is_beaten(tmp_path: Any) -> None:
    cells = [cell(name, cost, scene=scene, seed=seed) for name, cost, seed in
             (("draft", 10.0, 0), ("preview", 20.0, 0), ("final", 60.0, 0)) for scene in ("a", "b")]  # fmt: skip
    cells += [cell("draft seed=1", 10.0, seed=1) | {"changes": [], "preset": "draft"}]
    for found in cells:
        found["scores"]["input_smoke_db"] += math.log2(found["cpu_seconds"])
    steps = copy.deepcopy(cells)
    machine = {"processor": "P", "cores": 2, "memory_gib": 8.0, "system": "Linux"}
    whole = {"machine": machine, "versions": {"numpy": "2"}, "settings": {}, "trivial": {}, "sweeps": [], "cells": steps}
    assert "no: " not in trade_page.page(whole, [])
    for scene in ("a", "b"):
        steps.append(cell("draft visual.iterations=1", 5.0, scene=scene, input_smoke_db=steps[0]["scores"]["input_smoke_db"]))
    assert "no: `draft visual.iterations=1`" in trade_page.page(whole, [])


def test_values_of_a_setting_are_means_of_the_same_scenes() -> None:
    """A scene that one value lacks would make the others look different."""
    name = "preview visual.iterations=3"
    points = [["3", name], ["6", "preview"]]
    sweep = {"key": "visual.iterations", "base": "preview", "stage": "visual", "is_exponent": True, "points": points}
    cells = [cell("preview", side_db=30.0), cell("preview", scene="b", side_db=10.0), cell(name, side_db=29.0)]
    text = "\n".join(trade_page.settings({"sweeps": [sweep], "cells": cells}))
    assert "| 6 (base) | 1 |" in text and "| 30.00 |" in text and "| 20.00 |" not in text


def test_an_inspection_is_no_cost_of_a_setting() -> None:
    stage = {"seconds": 2.0, "cpu_seconds": 1.0, "peak_gib": 0.5}
    found = front.totals({"start": stage, "inspect": {**stage, "cpu_seconds": 9.0, "peak_gib": 0.7}, "visual": stage})
    assert found == {"seconds": 4.0, "cpu_seconds": 2.0, "peak_gib": 0.7}


def test_shared_stages_cost_what_the_donor_now_says() -> None:
    """Of a donor that was measured again; what a cell did itself keeps its cost."""
    donor, taking, own = cell("draft", 20.0), cell("draft visual.iterations=1", 50.0), cell("draft visual.iterations=2", 7.0)
    taking["stages"]["visual"]["is_taken_over"] = True
    shared = with_shared_costs([taking, own, donor, cell("draft visual.iterations=1", 3.0, scene="b")])
    assert [found["stages"]["visual"]["cpu_seconds"] for found in shared] == [10.0, 3.5, 10.0, 1.5]
    assert [found["stages"]["visual"]["is_taken_over"] for found in shared] == [True, False, False, False]


def test_the_plan_is_whole() -> None:
    every = [*compared(), *(trial for sweep in sweeps(threads=2) for _, trial in sweep.points)]
    ordered = with_donors(every)
    assert len({trial.name for trial in ordered}) == len(set(ordered)) == len(ordered)
    for place, trial in enumerate(ordered):
        assert trial.donor is None or (trial.donor in ordered[:place] and trial.donor.donor is None)
    assert {trial.threads for trial in every} == {1, 2}
    for sweep in sweeps(threads=1):
        assert sweep.key != "threads" and len({trial for _, trial in sweep.points}) == len(sweep.points) > 1
        if sweep.is_exponent:
            assert [int(value) for value, _ in sweep.points] == sorted(int(value) for value, _ in sweep.points)
    for trial in every:
        assert trial.preset in PRESETS and FRAMES[0] - 30 <= trial.frames[0] < trial.frames[1] == FRAMES[1]
    assert Trial(preset="draft", seed=1).donor == Trial(preset="draft")
