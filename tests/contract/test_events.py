"""The event lines: every event survives the way, and nothing else gets through."""

from __future__ import annotations

import dataclasses
import json
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from backend.contract import events
from backend.contract.events import ProtocolError, decode, encode, is_cancel

finite = st.floats(allow_nan=False, allow_infinity=False)
count = st.integers(-events.LARGEST_COUNT, events.LARGEST_COUNT)
text = st.text(st.characters(exclude_categories=["Cs"]))
every_event = st.one_of(
    st.builds(events.Hello, protocol=count, version=text, device=text),
    st.builds(events.Stage, name=text, index=count, count=count, skipped=st.booleans()),
    st.builds(
        events.Progress,
        stage=text,
        step=count,
        total=count,
        seconds_left=st.none() | finite,
        metrics=st.dictionaries(text, finite),
    ),
    st.builds(events.Artifact, kind=text, path=text, frame=st.none() | count),
    st.builds(events.Warning, code=text, message=text),
    st.builds(events.Done, result=text, seconds=finite),
    st.builds(events.Error, code=text, message=text, hint=text, stage=st.none() | text),
    st.builds(events.CancelledEvent, stage=st.none() | text),
)
any_json = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=12,
)


@given(every_event)
def test_each_event_survives_the_way(event):
    line = encode(event)
    assert "\n" not in line and line.isascii()
    assert decode(line) == event and decode(line.encode() + b"\n") == event


@given(st.binary(max_size=300) | st.text(max_size=300))
def test_noise_is_never_an_event(line):
    with pytest.raises(ProtocolError):
        decode(line)


@given(any_json)
def test_any_json_is_an_event_or_a_protocol_error(value):
    line = json.dumps(value)
    try:
        event = decode(line)
    except ProtocolError:
        return
    assert isinstance(event, events.Event)


@given(st.sampled_from(["progress", "stage", "hello", "done", "error"]), st.dictionaries(st.text(), any_json, max_size=5))
def test_missing_and_foreign_keys_are_protocol_errors(kind, values):
    values.pop("stage", None)
    with pytest.raises(ProtocolError):
        decode(json.dumps(values | {"event": kind}))


@given(every_event, st.data())
def test_each_field_keeps_its_type(event, data):
    """One field replaced by something of another type is refused."""
    values = json.loads(encode(event))
    name = data.draw(st.sampled_from([field.name for field in dataclasses.fields(event)]))
    with pytest.raises(ProtocolError):
        decode(json.dumps(values | {name: [values[name]]}))


@pytest.mark.parametrize(
    "line",
    [
        '{"event": "progress", "stage": "visual", "step": NaN, "total": 3}',
        '{"event": "progress", "stage": "visual", "step": 1, "total": 3, "seconds_left": Infinity}',
        '{"event": "progress", "stage": "visual", "step": 1, "total": 3, "seconds_left": 1e999}',
        '{"event": "progress", "stage": "visual", "step": 1, "total": 3, "metrics": {"loss": -Infinity}}',
        '{"event": "progress", "stage": "visual", "step": 1, "total": 3, "metrics": {"loss": 1e999}}',
        '{"event": "progress", "stage": "visual", "step": 1, "total": 3, "metrics": {"loss": "low"}}',
        '{"event": "progress", "stage": "visual", "step": 1, "total": 3, "metrics": {"ok": true}}',
        '{"event": "progress", "stage": "visual", "step": true, "total": 3}',
        '{"event": "progress", "stage": "visual", "step": 1.0, "total": 3}',
        '{"event": "stage", "name": "visual", "index": 0, "count": 1, "skipped": 1}',
        '{"event": "unheard_of"}',
        '{"event": null}',
        '{"event": "done"}',
        '{"event": "done", "result": "r", "seconds": 1} trailing',
        "",
        "null",
        "[]",
        '{"event": "cancelled"',
        "[" * 100_000,
        " " * (events.MAX_LINE_BYTES + 1),
    ],
)
def test_each_of_these_is_refused(line):
    with pytest.raises(ProtocolError):
        decode(line)


def test_unknown_keys_of_a_newer_backend_are_passed_over():
    line = '{"event": "done", "result": "result.json", "seconds": 2, "new": {"a": 1}}'
    assert decode(line) == events.Done(result="result.json", seconds=2)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_what_is_not_finite_is_never_written(value):
    with pytest.raises(ValueError):
        encode(events.Progress(stage="visual", step=1, total=2, metrics={"loss": value}))


@given(st.text() | st.binary() | any_json.map(json.dumps))
def test_only_a_cancel_is_a_cancel(line):
    assert not is_cancel(line) or json.loads(line)["command"] == "cancel"


def test_the_cancel_line():
    assert is_cancel(events.CANCEL_LINE) and is_cancel(events.CANCEL_LINE.encode() + b"\n")
    assert not is_cancel("") and not is_cancel("cancel") and not is_cancel('["cancel"]') and not is_cancel("[" * 100_000)
