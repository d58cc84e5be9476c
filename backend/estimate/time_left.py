"""What is left of a running job: the estimate of each stage, corrected by how the job has gone so far."""

from __future__ import annotations

from collections.abc import Mapping

TRUSTED_SECONDS = 5.0  # of measured work until what was measured weighs as much as what was estimated
TRUSTED_SHARE = 0.25  # of a stage, from which on its own pace alone tells
LARGEST_FACTOR = 20.0  # a machine that sleeps for an hour does not make the rest take days


class TimeLeft:
    """Of one job. estimated: seconds of each of its stages, in order; empty where nothing was estimated.

    Times are seconds of a clock that never goes back.
    """

    def __init__(self, estimated: Mapping[str, float]) -> None:
        self._ahead = dict(estimated)  # of this stage and those behind it
        self._measured = 0.0  # seconds of the stages that are over, and what they should have taken
        self._expected = 0.0
        self._stage = ""
        self._began = 0.0
        self._first: int | None = None  # the step that the stage began at: a resumed one does not begin at 0
        self._wanted = 0.0  # estimated seconds of what is to be done of this stage

    def begin(self, stage: str, now: float, *, is_skipped: bool = False) -> float | None:
        """A stage begins, the one before is over. Returns the seconds left in the job, None where nothing was estimated."""
        if self._wanted > 0.0:
            self._measured += now - self._began
            self._expected += self._wanted
        self._ahead.pop(self._stage, None)
        if is_skipped:
            self._ahead.pop(stage, None)
        self._stage, self._began, self._first = stage, now, None
        self._wanted = self._ahead.get(stage, 0.0)
        return self._factor() * sum(self._ahead.values()) if self._ahead else None

    def left(self, step: int, total: int, now: float) -> tuple[float | None, float | None]:
        """Seconds left in the stage and in the whole job, once `step` of `total` steps are done; None while unknown."""
        if self._first is None:
            self._first = min(step, total)
            self._wanted *= 1.0 - self._first / total if total > 0 else 1.0
        elapsed, to_do = now - self._began, total - self._first
        share = min(max((step - self._first) / to_do, 0.0), 1.0) if to_do > 0 else 1.0  # steps that are done anew count as none
        by_pace = elapsed * (1.0 - share) / share if share > 0.0 else None
        if self._stage not in self._ahead:
            return by_pace, None
        whole = self._factor() * self._wanted
        by_estimate = max(whole - elapsed, 0.0) if by_pace is None else whole * (1.0 - share)
        weight = min(1.0, share / TRUSTED_SHARE)
        in_stage = by_estimate if by_pace is None else weight * by_pace + (1.0 - weight) * by_estimate
        behind = sum(seconds for stage, seconds in self._ahead.items() if stage != self._stage)
        return in_stage, in_stage + self._factor(elapsed, share) * behind

    def _factor(self, elapsed: float = 0.0, share: float = 0.0) -> float:
        """How many times as long as estimated everything takes, by what is over and by the share of this stage that is."""
        measured = TRUSTED_SECONDS + self._measured + (elapsed if share > 0.0 else 0.0)
        expected = TRUSTED_SECONDS + self._expected + share * self._wanted
        return min(max(measured / expected, 1.0 / LARGEST_FACTOR), LARGEST_FACTOR)
