"""What docs/synthetic.md says of renders is what benchmarks.cycles_trade and benchmarks.blender_parity wrote."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

DOCS = Path(__file__).resolve().parents[2] / "docs"
PAGE = " ".join((DOCS / "synthetic.md").read_text(encoding="utf-8").split())
TRADE: list[dict[str, Any]] = json.loads((DOCS / "results" / "cycles_trade.json").read_text(encoding="utf-8"))
PARITY: list[dict[str, Any]] = json.loads((DOCS / "results" / "blender_parity.json").read_text(encoding="utf-8"))["rows"]


def case(axis: str = "samples", blender: str = "5.2.3", layer: str = "clip", **wanted: object) -> dict[str, Any]:
    """The measured one; a step a voxel, at full size, denoised and marched, where nothing else is asked."""
    usual: dict[str, object] = {"is_denoised": True, "is_biased": True, "scale": 1.0, "step_rate": 1.0}
    wanted = {**usual, "axis": axis, "layer": layer, **wanted}
    found = [
        row for row in TRADE if row["blender"].startswith(blender) and all(row[name] == value for name, value in wanted.items())
    ]
    assert len(found) == 1, wanted
    return found[0]


def error(**wanted: Any) -> str:
    return f"{case(**wanted)['smoke_error']:.4f}"


def ratio(of: dict[str, Any], to: dict[str, Any], name: str = "cpu_seconds") -> float:
    return float(of[name] / to[name])


def parity(layer: str, between: str, name: str) -> float:
    return float(next(row for row in PARITY if row["layer"] == layer and row["between"] == between)[name])


PLAIN = error(samples=32, is_denoised=False)
DEARER = case(samples=8, is_biased=False)["cpu_seconds"] - case(samples=8)["cpu_seconds"]
NONE, ONE, TWO, FOUR = (case(axis="bounces", bounces=count)["smoke_error"] for count in (0, 1, 2, 4))
FINER, USUAL, COARSER = (case(axis="step rate", step_rate=rate) for rate in (0.5, 1.0, 2.0))
HALF, FULL = (case(axis="resolution", scale=scale) for scale in (0.5, 1.0))


@pytest.mark.parametrize(
    "sentence",
    [
        f"4 denoised ones ({error(samples=4)}) are nearer to the truth than 32 plain ones ({PLAIN})",
        f"from 8 to 16 the error falls by a sixth ({error(samples=8)} to {error(samples=16)}) for "
        f"{ratio(case(samples=16), case(samples=8)):.1f} times the time",
        f"`paper` takes 64 ({error(samples=64)}): 256 would bring {error(samples=256)} for "
        f"{ratio(case(samples=256), case(samples=64)):.1f} times the time",
        f"unbiased ones are noisier and cost {DEARER:.0f} s",
        f"0 or 1 darken the smoke visibly ({NONE:.3f}, {ONE:.3f}), 2 nearly suffice ({TWO:.4f}), from 4 on nothing changes "
        f"({FOUR:.4f})",
        f"half steps cost {100 * ratio(FINER, USUAL) - 100:.0f} %",
        f"Steps of two voxels save {100 - 100 * ratio(COARSER, USUAL):.0f} %",
        f"take {ratio(HALF, FULL):.1f} of the time, for {ratio(HALF, FULL, 'smoke_error'):.1f} times the error",
        f"few samples in Blender 4.5 (8: {error(blender='4.5.15', layer='opacity', samples=8)}), more in 5.2 "
        f"({error(layer='opacity', samples=8)})",
        f"the same smoke ({parity('smoke', '4.5.15 LTS and 4.3.2', 'difference'):.4f}, noise "
        f"{parity('smoke', '4.5.15 LTS and 4.3.2', 'noise'):.3f})",
        f"blocks of the plate differ by {parity('plate', '5.2.3 LTS and 4.3.2', 'blocks'):.3f}",
        f"draws the same plate and depth ({parity('plate', '5.2.3 LTS and 5.2.2 LTS', 'difference'):.5f})",
    ],
)
def test_the_page_says_what_was_measured(sentence: str) -> None:
    assert sentence in PAGE


def test_what_the_page_says_in_words_holds() -> None:
    fourth = ratio(case(samples=4), case(samples=32, is_denoised=False))
    assert 0.2 < fourth < 0.3  # "cost a quarter"
    assert 0.8 < ratio(case(samples=16), case(samples=8), "smoke_error") < 0.86  # "falls by a sixth"
    assert 0.0 < 1 - ratio(FINER, USUAL, "smoke_error") < 0.02  # "bring 1 %"
    assert 0.08 < ratio(COARSER, USUAL, "smoke_error") - 1 < 0.12  # "a tenth of the accuracy"
    wheels = [row for row in PARITY if row["between"] == "4.5.15 LTS and 5.2.3 LTS"]
    assert len(wheels) == 4
    assert f"{max(row['blocks'] for row in wheels):.4f}" == "0.0006" and "within 0.0006" in PAGE
    clip = next(row for row in wheels if row["layer"] == "clip")
    assert clip["difference"] < clip["noise"] / 3  # "the clip within a third of the noise"
