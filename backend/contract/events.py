"""The lines the backend writes to its standard output, and the commands it reads from its input.

One JSON object a line, no NaN. `Hello` comes first; exactly one of `Done`, `Error`, `CancelledEvent` comes last.
A stream without one of these at its end is a crash.
"""

from __future__ import annotations

import dataclasses
import json
import math
from dataclasses import dataclass, field
from typing import Any, ClassVar

PROTOCOL_VERSION = 1
MAX_LINE_BYTES = 1 << 20  # a longer line is not an event
LARGEST_COUNT = 2**63 - 1  # shares of larger ones overflow
MAX_PROGRESS_PER_SECOND = 10.0


class ProtocolError(ValueError):
    """A line that is not a valid event or command."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Hello:
    """First line: which protocol, which backend, which device ("cpu" or "cuda")."""

    event: ClassVar[str] = "hello"
    protocol: int
    version: str
    device: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Stage:
    """A stage begins (`skipped`: its file was there already, nothing is computed). index counts from 0.

    job_seconds_left: of the whole job, None while unknown.
    """

    event: ClassVar[str] = "stage"
    name: str
    index: int
    count: int
    skipped: bool = False
    job_seconds_left: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Progress:
    """Step `step` of `total` of a stage is done; seconds_left is of the stage, job_seconds_left of the whole job, None while
    unknown."""

    event: ClassVar[str] = "progress"
    stage: str
    step: int
    total: int
    seconds_left: float | None = None
    job_seconds_left: float | None = None
    metrics: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, kw_only=True)
class Artifact:
    """A file is complete. path is relative to the job folder; frame counts from 0, None if it holds many."""

    event: ClassVar[str] = "artifact"
    kind: str
    path: str
    frame: int | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Warning:
    """Something the user should know; the work goes on."""

    event: ClassVar[str] = "warning"
    code: str
    message: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Done:
    """Last line of a success. result: path of result.json, relative to the job folder."""

    event: ClassVar[str] = "done"
    result: str
    seconds: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Error:
    """Last line of a failure: what is wrong, and what to do."""

    event: ClassVar[str] = "error"
    code: str
    message: str
    hint: str
    stage: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class CancelledEvent:
    """Last line after a cancel."""

    event: ClassVar[str] = "cancelled"
    stage: str | None = None


Event = Hello | Stage | Progress | Artifact | Warning | Done | Error | CancelledEvent
LAST_EVENTS = (Done, Error, CancelledEvent)
_TYPES: dict[str, type] = {kind.event: kind for kind in (Hello, Stage, Progress, Artifact, Warning, Done, Error, CancelledEvent)}
_FIELD_TYPES: dict[str, tuple[type, ...]] = {
    "int": (int,),
    "str": (str,),
    "bool": (bool,),
    "float": (int, float),
    "float | None": (int, float, type(None)),
    "int | None": (int, type(None)),
    "str | None": (str, type(None)),
    "dict[str, float]": (dict,),
}


def encode(event: Event) -> str:
    """One line of JSON without a newline. Raises ValueError on NaN or infinity."""
    return json.dumps({"event": event.event, **dataclasses.asdict(event)}, allow_nan=False, ensure_ascii=True)


def decode(line: str | bytes) -> Event:
    """The event in one line. Unknown keys are ignored (a newer backend may add some); all else is a ProtocolError."""
    if len(line) > MAX_LINE_BYTES:
        raise ProtocolError(f"a line of {len(line)} bytes is longer than an event may be")
    try:
        data = json.loads(line, parse_constant=_reject_constant)
    except (ValueError, RecursionError) as error:
        raise ProtocolError(f"not JSON: {error}") from error
    if not isinstance(data, dict) or not isinstance(data.get("event"), str) or data["event"] not in _TYPES:
        raise ProtocolError("not an event")
    kind = _TYPES[data["event"]]
    values: dict[str, Any] = {}
    for item in dataclasses.fields(kind):
        if item.name in data:
            values[item.name] = _checked(item.name, data[item.name], str(item.type))
        elif item.default is dataclasses.MISSING and item.default_factory is dataclasses.MISSING:
            raise ProtocolError(f"{kind.event}: {item.name} is missing")
    return kind(**values)


def _checked(name: str, value: Any, annotation: str) -> Any:
    allowed = _FIELD_TYPES[annotation]
    if not isinstance(value, allowed) or (isinstance(value, bool) and bool not in allowed):
        raise ProtocolError(f"{name}: {type(value).__name__} where {annotation} is expected")
    numbers = value.values() if isinstance(value, dict) else [value]
    for number in numbers:
        if isinstance(value, dict) and (isinstance(number, bool) or not isinstance(number, (int, float))):
            raise ProtocolError(f"{name}: not all numbers")
        if isinstance(number, float) and not math.isfinite(number):
            raise ProtocolError(f"{name}: not finite")
        if isinstance(number, int) and abs(number) > LARGEST_COUNT:
            raise ProtocolError(f"{name}: beyond 64 bits")
    return value


def _reject_constant(name: str) -> Any:
    raise ValueError(f"{name} is not allowed")


def is_cancel(line: str | bytes) -> bool:
    """Whether a line on the backend's standard input asks it to stop."""
    try:
        data = json.loads(line)
    except (ValueError, RecursionError):
        return False
    return isinstance(data, dict) and data.get("command") == "cancel"


CANCEL_LINE = json.dumps({"command": "cancel"})
