"""What is said before a job and while it runs: monotonic in the work, told from files that commands wrote, never nonsense."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from backend.contract.estimates import Estimate, Quality, kept_estimate, quality_text, read_estimate, spoken
from backend.contract.job import PRESETS, override, preset_config
from backend.estimate import machine as machines
from backend.estimate.machine import PIECES, Machine, fastest, machine_key, this_machine
from backend.estimate.predict import COSTS_FILE, QUALITY_FILE, costs, estimate, memory_gib, quality_of, stage_seconds
from backend.estimate.time_left import LARGEST_FACTOR, TRUSTED_SECONDS, TimeLeft
from backend.estimate.work import kinds_of, terms_of
from backend.fit.survey import Pace, Survey
from backend.pipeline import STAGES
from tools import estimate_quality

MACHINE = Machine(seconds={"splat": 0.02, "pixels": 0.01, "voxels": 0.005, "network": 0.2}, threads=2)
ESTIMATED = {"frames": 10.0, "visual": 30.0, "export": 20.0}


def seen(**changes) -> Survey:
    plain = Survey(
        size=(320, 180),
        source_size=(1280, 720),
        num_frames=100,
        mode="matte",
        mode_reason="It has a background.",
        measured={},
        smoke_share=0.2,
        fullest_share=0.3,
        opaque_share=0.1,
        one_hue_error=1e-4,
        detail_errors={},
        turn=0.0,
        has_cameras=False,
        motion=None,
        pace=Pace(decode=1e-3, reduce=2e-3, prepare=0.5, extract=3e-3, whole=1.0),
    )
    return dataclasses.replace(plain, **changes)


# -- before the job


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("method", ["default", "as_published"])
@pytest.mark.parametrize("asks", [True, False])
def test_every_stage_is_counted_and_every_term_known(preset: str, method: str, asks: bool) -> None:
    config = override(preset_config(preset), {"method": method, "volume.use_prior": asks})
    terms = terms_of(seen(), config, threads=2)
    assert ("volume" in terms) == (asks and method == "default")
    assert set(terms) <= {"start", *STAGES} and list(terms) == sorted(terms, key=["start", *STAGES].index)
    assert {term.kind for of in terms.values() for term in of} <= set(kinds_of(config)) <= set(PIECES)
    found = stage_seconds(seen(), config, machine=MACHINE)
    assert all(math.isfinite(seconds) and seconds >= 0.0 for seconds in found.values())
    assert all(found[stage] > 0.0 for stage in ("inspect", "frames", "smoke", "physical", "visual", "export"))
    names = {stage: {term.name for term in of} for stage, of in terms.items()}
    assert all(names[stage] <= set(costs()["stages"][stage]) for stage in names)


def test_the_prior_is_asked_now_and_then() -> None:
    """Every fifth of a hundred frames, and twice about five before; every fourth of ten, where half of that is the longest
    stride, and twice about one."""
    counts = {}
    for frames in (10, 100):
        terms = terms_of(seen(num_frames=frames), preset_config("draft"), threads=1)["volume"]
        counts[frames] = {term.name: term.amount for term in terms}
    assert counts[100]["propose"] == pytest.approx(20 + 2 * 5)
    assert counts[10]["propose"] == pytest.approx(3 + 2 * 1)


@pytest.mark.parametrize(
    "more",
    [
        lambda clip, config: (dataclasses.replace(clip, num_frames=200), config),
        lambda clip, config: (clip, override(config, {"frames.working_size": 960})),
        lambda clip, config: (clip, override(config, {"visual.num_particles": 60000})),
        lambda clip, config: (clip, override(config, {"visual.iterations": 60})),
        lambda clip, config: (clip, override(config, {"forecast.num_frames": 50})),
        lambda clip, config: (clip, override(config, {"volume.use_prior": True})),
        lambda clip, config: (dataclasses.replace(clip, pace=dataclasses.replace(clip.pace, decode=0.1)), config),
    ],
)
def test_more_work_takes_longer(more) -> None:
    clip, config = seen(), override(preset_config("preview"), {"volume.use_prior": False})
    before = sum(stage_seconds(clip, config, machine=MACHINE).values())
    assert sum(stage_seconds(*more(clip, config), machine=MACHINE).values()) > before
    slower = Machine(seconds={kind: 2.0 * seconds for kind, seconds in MACHINE.seconds.items()}, threads=2)
    assert sum(stage_seconds(clip, config, machine=slower).values()) > before
    assert memory_gib(*more(clip, config)) >= memory_gib(clip, config) > 0.1


def test_presets_take_longer_in_their_order_and_say_what_was_measured() -> None:
    found = [estimate(seen(turn=1.0), preset_config(name), preset=name, machine=MACHINE) for name in PRESETS]
    assert found[0].seconds < found[1].seconds < found[2].seconds
    known = json.loads(QUALITY_FILE.read_text(encoding="utf-8"))["presets"]
    for item in found:
        assert [quality.view for quality in item.quality] == (["input", "side"] if item.preset in known else [])
        assert ("not measured" in item.to_text()) == (item.preset not in known)
        assert read_estimate(item.to_json()) == item
    chosen = estimate(seen(), preset_config("draft"), preset="draft", chosen=["visual.iterations"], machine=MACHINE)
    assert chosen.quality == (), "nobody measured these settings"
    kept = estimate(seen(), preset_config("draft"), preset="draft", chosen=["export.max_voxels"], machine=MACHINE)
    assert kept.quality == quality_of("draft", is_seen_around=True)
    assert quality_of("draft", is_seen_around=False) == kept.quality[:1], "a camera that stands still sees no side"


def test_the_quality_is_the_benchmarks() -> None:
    """Else: python -m tools.estimate_quality."""
    assert QUALITY_FILE.read_text(encoding="utf-8") == estimate_quality.text()


def test_the_coefficients_say_what_made_them() -> None:
    found = json.loads(COSTS_FILE.read_text(encoding="utf-8"))
    assert found["made_by"] == "python -m benchmarks.estimates --fit"
    assert all(value >= 0.0 for of in found["stages"].values() for value in of.values())


def test_quality_is_condensed_by_hand() -> None:
    def cell(preset: str, smoke: float, side: float, method: str = "default") -> dict:
        scores = {"input": {"ours": {"smoke_db": smoke}}, "side": {"ours": {"full_db": side}}}
        return {"preset": preset, "method": method, "scores": scores}

    cells = [
        cell("draft", 30.0, 20.0),
        cell("draft", 34.0, 20.0),
        cell("draft", 0.0, 0.0, "as_published"),
        cell("final", 40.0, 22.0),
    ]
    found = estimate_quality.condensed({"cells": cells})["presets"]
    assert list(found) == ["draft"], "of one scene there is no spread"
    assert found["draft"]["input"] == {"mean_db": 32.0, "spread_db": 2.83, "num_scenes": 2}


@pytest.mark.parametrize(
    ("low", "high", "words"),
    [
        (0.0, 0.4, "1 s"),
        (5.0, 11.0, "5 to 11 s"),
        (40.0, 40.2, "40 s"),
        (80.0, 180.0, "1.3 to 3 min"),
        (4e3, 9e3, "1.1 to 2.5 h"),
    ],
)
def test_spans_are_spoken(low: float, high: float, words: str) -> None:
    assert spoken(low, high) == words


def test_an_estimate_in_words() -> None:
    quality = (
        Quality(view="input", mean_db=32.4, spread_db=2.0, num_scenes=5),
        Quality(view="side", mean_db=23.2, spread_db=3.9, num_scenes=5),
    )
    assert quality_text(quality) == "32 ± 2 dB in the clip's own view, 23 ± 4 dB from the side on 5 test scenes"
    item = Estimate(preset="draft", seconds=60.0, stages={"visual": 60.0}, memory_gib=0.61, compile_seconds=60.0)
    assert item.to_text().startswith(
        "draft: 40 to 90 s, 0.6 GiB, and once 60 s for this version's first run; quality: not measured"
    )


@pytest.mark.parametrize(
    "change",
    [
        {"seconds": "60"},
        {"seconds": -1.0},
        {"stages": {"visual": None}},
        {"quality": [{"view": "input"}]},
        {"format_version": 2},
        {"preset": 3},
        {"more": 1},
    ],
)
def test_a_damaged_estimate_is_refused(change: dict) -> None:
    item = Estimate(preset="draft", seconds=60.0, stages={"visual": 60.0}, memory_gib=0.6)
    with pytest.raises((ValueError, TypeError, KeyError, AttributeError)):
        read_estimate(json.dumps(json.loads(item.to_json()) | change))


def test_an_estimate_of_another_job_is_none(tmp_path: Path) -> None:
    item = Estimate(preset="draft", seconds=60.0, stages={"visual": 60.0}, memory_gib=0.6, fingerprint="abc")
    assert kept_estimate(tmp_path, fingerprint="abc") is None
    (tmp_path / "estimate.json").write_text(item.to_json(), encoding="utf-8")
    assert kept_estimate(tmp_path, fingerprint="abc") == item and kept_estimate(tmp_path, fingerprint="abd") is None
    (tmp_path / "estimate.json").write_text(item.to_json()[:-9], encoding="utf-8")
    assert kept_estimate(tmp_path, fingerprint="abc") is None


# -- the machine


@pytest.fixture
def counted(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Stands in for the kernels; the kinds that were measured."""
    measured: list[str] = []

    def make(kind: str):
        measured.append(kind)
        return lambda: sum(range(2000))

    monkeypatch.setattr(machines, "PIECES", {kind: (lambda kind=kind: make(kind)) for kind in PIECES})
    return measured


def test_it_is_measured_once_and_again_when_something_changes(counted, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = this_machine(["splat", "pixels"], folder=tmp_path)
    assert counted == ["splat", "pixels"] and this_machine(["splat", "pixels"], folder=tmp_path) == first
    this_machine(["splat", "network"], folder=tmp_path)
    assert counted == ["splat", "pixels", "network"], "only what was missing"
    kept = json.loads((tmp_path / "machine.json").read_text(encoding="utf-8"))
    assert kept["machine"] == machine_key() and set(kept["seconds"]) == {"splat", "pixels", "network"}
    monkeypatch.setattr(machines, "__version__", "9.9")
    this_machine(["splat"], folder=tmp_path)
    assert counted[3:] == ["splat"]


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"machine": 3, "seconds": {}}', '{"seconds": {"splat": 1}}', "\x00"])
def test_a_damaged_file_is_measured_anew(counted, tmp_path: Path, text: str) -> None:
    (tmp_path / "machine.json").write_text(text, encoding="utf-8")
    assert this_machine(["splat"], folder=tmp_path).seconds["splat"] > 0.0 and counted == ["splat"]


def test_absurd_figures_are_measured_anew_and_a_folder_that_cannot_be_is_no_obstacle(counted, tmp_path: Path) -> None:
    text = json.dumps({"machine": machine_key(), "seconds": {"splat": -1.0, "pixels": 1e9, "voxels": 0.5}})
    (tmp_path / "machine.json").write_text(text, encoding="utf-8")
    assert this_machine(["splat", "pixels", "voxels"], folder=tmp_path).seconds["voxels"] == 0.5
    assert counted == ["splat", "pixels"]
    (tmp_path / "file").write_text("")
    assert this_machine(["splat"], folder=tmp_path / "file" / "cache").seconds["splat"] > 0.0


@pytest.mark.parametrize("kind", ["splat", "pixels", "voxels"])
def test_the_real_pieces_take_a_moment(kind: str) -> None:
    assert 1e-5 < fastest(PIECES[kind]()) < 5.0


# -- while it runs


def test_as_estimated_by_hand() -> None:
    left = TimeLeft(ESTIMATED)
    assert left.begin("frames", 0.0) == pytest.approx(60.0)
    assert left.left(0, 10, 0.0) == pytest.approx((10.0, 60.0))
    assert left.left(5, 10, 5.0) == pytest.approx((5.0, 55.0))
    assert left.begin("visual", 10.0) == pytest.approx(50.0)
    assert left.left(0, 3, 10.0) == pytest.approx((30.0, 50.0))
    assert left.left(3, 3, 40.0) == pytest.approx((0.0, 20.0))
    assert left.begin("export", 40.0) == pytest.approx(20.0)
    assert left.left(20, 20, 60.0) == pytest.approx((0.0, 0.0))


def test_a_machine_at_half_its_speed_is_found_out() -> None:
    left = TimeLeft(ESTIMATED)
    left.begin("frames", 0.0)
    left.left(0, 10, 0.0)
    stage, whole = left.left(5, 10, 10.0)
    assert stage == pytest.approx(10.0) and 60.0 < whole < 110.0
    after = left.begin("visual", 20.0)
    assert after == pytest.approx((TRUSTED_SECONDS + 20.0) / (TRUSTED_SECONDS + 10.0) * 50.0)
    left.left(0, 30, 20.0)
    stage, whole = left.left(27, 30, 74.0)
    assert stage == pytest.approx(6.0) and whole == pytest.approx(6.0 + 20.0 * 79.0 / 42.0, rel=1e-6)


def test_what_is_there_is_not_waited_for() -> None:
    left = TimeLeft(ESTIMATED)
    assert left.begin("frames", 0.0, is_skipped=True) == pytest.approx(50.0)
    assert left.begin("visual", 0.1) == pytest.approx(50.0)
    stage, whole = left.left(15, 30, 0.1)
    assert (stage, whole) == pytest.approx((15.0, 35.0)), "half of it was kept from an earlier run"
    assert left.left(30, 30, 15.1)[1] == pytest.approx(20.0)


def test_without_an_estimate_the_pace_tells_of_the_stage_alone() -> None:
    left = TimeLeft({})
    assert left.begin("frames", 3.0) is None
    assert left.left(0, 4, 3.0) == (None, None)
    assert left.left(1, 4, 5.0) == (pytest.approx(6.0), None)


steps = st.lists(st.tuples(st.integers(0, 50), st.integers(0, 50), st.floats(0.0, 1e5)), max_size=20)


@given(steps)
@example([(19, 38, 0.0), (0, 38, 0.0)])  # a step is done anew before any time has passed
def test_it_is_never_negative_nor_absurd(taken) -> None:
    left, now = TimeLeft(ESTIMATED), 0.0
    for name in ESTIMATED:
        assert 0.0 <= left.begin(name, now) <= LARGEST_FACTOR * 60.0 + 1e-6
        for step, total, seconds in taken:
            now += seconds
            for value in left.left(min(step, total), total, now):
                assert value is None or (math.isfinite(value) and value >= 0.0)
