"""What the user should know when a limit of the settings holds the fluid back."""

from __future__ import annotations

from backend.physics.state import StepReport
from backend.reporting import Report

CLAMPED_SHARE = 0.01  # of the particles in a substep: fewer are strays, and nobody sees them


def warn_of_substeps(report: Report, taken: StepReport, num_particles: int, *, allowed: int) -> None:
    """A warning where a step needed more substeps than it was allowed, and particles were slowed for it."""
    if taken.num_clamped <= CLAMPED_SHARE * num_particles * taken.substeps:
        return
    report.warning(
        "substeps_limited",
        f"The smoke moves faster than {allowed} substeps a frame can follow, and is slowed where it does. "
        "A larger physical.max_substeps lets it go.",
    )
