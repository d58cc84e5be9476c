"""The scores as text, for a terminal."""

from __future__ import annotations

from typing import Any

from backend.score.compare import OURS

COLUMNS = {  # figure -> heading, digits
    "full_db": ("dB full", 2),
    "smoke_db": ("smoke", 2),
    "first_db": ("first", 2),
    "middle_db": ("middle", 2),
    "last_db": ("last", 2),
    "global_db": ("global", 2),
    "ssim": ("SSIM", 4),
    "smoke_ssim": ("smoke", 4),
    "lpips": ("LPIPS", 4),
    "st_lpips": ("ST-LPIPS", 4),
    "dtssd": ("dtSSD", 4),
    "change_ratio": ("change", 2),
}


def table(scores: dict[str, Any]) -> str:
    """A row for each view and answer, then what is no picture."""
    views = {name: found for name, found in scores.items() if isinstance(found, dict) and OURS in found}
    columns = {key: column for key, column in COLUMNS.items() if any(key in found[OURS] for found in views.values())}
    wide = max(14, *(len(view) for view in views))
    lines = [f"{scores['scene']:<{wide}} {'answer':<22} " + " ".join(f"{heading:>8}" for heading, _ in columns.values())]
    for view, answers in views.items():
        for answer, found in answers.items():
            cells = (_number(found.get(key), digits) for key, (_, digits) in columns.items())
            lines.append(f"{view:<{wide}} {answer:<22} " + " ".join(f"{cell:>8}" for cell in cells))
    for view, found in scores.get("motion", {}).items():
        if found:
            lines.append(f"{view:<{wide}} tOF {found['tof']} px, of an answer that never moves {found['still']}")
    for name in ("volume", "prior_volume", "exported", "divergence", "buoyancy"):
        found = scores.get(name, {})
        figures = {key: value for key, value in found.items() if key != "velocity"} | found.get("velocity", {})
        lines += [f"{name:<{wide}} {key} {value}" for key, value in figures.items()]
    lines += [f"{'not measured':<{wide}} {name}: {reason}" for name, reason in scores.get("not_measured", {}).items()]
    return "\n".join(lines)


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
