"""What a clip requires: the choices made from it before anything is fitted, each with its reason and what was measured.

A decision sets settings that the user left to the clip; one that the user made is kept as it is and says so. The job
folder holds them in decisions.json.
"""

from __future__ import annotations

import dataclasses
import json
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from .errors import BackendError
from .job import Config, override, settable_keys

DECISIONS_FILE = "decisions.json"
DECISIONS_FORMAT_VERSION = 1


@dataclass(frozen=True, slots=True, kw_only=True)
class Decision:
    """One choice.

    name: stable, in snake_case. value: what was chosen, in a word or number. reason: why, in one sentence. measured: the
    quantities behind it. sets: the settings that it gives values, nothing where they stand already as they should.
    keys: the settings with which the user decides instead. is_overridden: the user did.
    """

    name: str
    value: str | int
    reason: str
    measured: dict[str, float] = field(default_factory=dict)
    sets: dict[str, Any] = field(default_factory=dict)
    keys: tuple[str, ...] = ()
    is_overridden: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Warned:
    """A warning that goes with the decisions, as the event `warning` has it."""

    code: str
    message: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Decisions:
    """All of a clip. fingerprint: of what they follow from."""

    decisions: tuple[Decision, ...]
    warnings: tuple[Warned, ...] = ()
    fingerprint: str = ""

    def __getitem__(self, name: str) -> Decision:
        """By name. Raises KeyError."""
        for decision in self.decisions:
            if decision.name == name:
                return decision
        raise KeyError(name)

    def followed(self, config: Config) -> Config:
        """The settings with what was decided in place of what was left to the clip."""
        changes = {key: value for decision in self.decisions for key, value in decision.sets.items()}
        return override(config, changes)

    def to_json(self) -> str:
        data = {"format_version": DECISIONS_FORMAT_VERSION, **dataclasses.asdict(self)}
        return json.dumps(data, indent=2, allow_nan=False)

    def to_text(self) -> str:
        """For people: one decision a paragraph."""
        width = max((len(decision.name) for decision in self.decisions), default=0)
        return "\n".join(line for decision in self.decisions for line in _lines(decision, width))


def _lines(decision: Decision, width: int) -> list[str]:
    name = decision.name.replace("_", " ")
    lines = [f"{name:<{width}}  {decision.value}: {decision.reason}"]
    if decision.measured:
        figures = ", ".join(f"{name.replace('_', ' ')} {value:.4g}" for name, value in decision.measured.items())
        lines.append(f"{'':<{width}}  ({figures})")
    if decision.keys:
        made = "; ".join(f"{key}={value}" for key, value in decision.sets.items())
        says = f"sets {made}; " if made else ""
        lines.append(f"{'':<{width}}  {says}decide it yourself with --set {decision.keys[0]}=...")
    return lines


def read_decisions(job_folder: str | os.PathLike[str]) -> Decisions:
    """The decisions of a job. Raises BackendError where there are none or the file is damaged."""
    path = Path(job_folder) / DECISIONS_FILE
    hint = "Run the job; it looks at the clip first."
    if not path.is_file():
        raise BackendError("no_decisions", f"{job_folder} holds no decisions yet.", hint=hint)
    try:
        data = json.loads(path.read_text(encoding="utf-8"), parse_constant=_refused)
        return decisions_of(data)
    except (OSError, ValueError, TypeError, KeyError, AttributeError, OverflowError, RecursionError) as error:
        raise BackendError("decisions_unreadable", f"{path} cannot be read: {error}.", hint=hint) from error


def decisions_of(data: Mapping[str, Any]) -> Decisions:
    """From what to_json() wrote. Raises ValueError, TypeError or KeyError where it is anything else."""
    if data["format_version"] != DECISIONS_FORMAT_VERSION:
        raise ValueError("another format version")
    warnings = tuple(Warned(code=_text(entry["code"]), message=_text(entry["message"])) for entry in data["warnings"])
    made = tuple(_decision(entry) for entry in data["decisions"])
    return Decisions(decisions=made, warnings=warnings, fingerprint=_text(data["fingerprint"]))


def _decision(entry: Mapping[str, Any]) -> Decision:
    unknown = set(entry["sets"]) - set(settable_keys(Config()))
    if unknown:
        raise ValueError(f"unknown setting {sorted(unknown)[0]!r}")
    value = entry["value"]
    if isinstance(value, bool) or not isinstance(value, (str, int)):
        raise ValueError("a value is neither text nor a whole number")
    if not isinstance(entry["is_overridden"], bool):
        raise ValueError("is_overridden is not true or false")
    return Decision(
        name=_text(entry["name"]),
        value=value,
        reason=_text(entry["reason"]),
        measured={_text(name): _number(found) for name, found in entry["measured"].items()},
        sets=dict(entry["sets"]),
        keys=tuple(_text(key) for key in entry["keys"]),
        is_overridden=entry["is_overridden"],
    )


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise ValueError(f"{value!r} is no text")
    return value


def _number(value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise ValueError(f"{value!r} is no number")
    return float(value)


def _refused(name: str) -> Any:
    raise ValueError(f"{name} is not allowed")
