"""The state file: what is taken from it, and what is not."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.faces.snmp.engine import MAX_BOOTS, Engine, new_engine_id, parse_state, state_text


@given(st.binary(min_size=5, max_size=32), st.integers(1, MAX_BOOTS))
def test_what_is_written_is_read_back(engine_id: bytes, boots: int) -> None:
    assert parse_state(state_text(engine_id, boots)) == (engine_id, boots)


@given(st.data())
def test_no_damaged_file_is_believed(data: st.DataObject) -> None:
    whole = state_text(bytes(range(17)), 41)
    damaged = bytearray(whole)
    at = data.draw(st.integers(0, len(whole) - 1))
    match data.draw(st.sampled_from(["flip", "cut", "insert"])):
        case "flip":
            damaged[at] ^= data.draw(st.integers(1, 255))
        case "cut":
            del damaged[at:]
        case _:
            damaged.insert(at, data.draw(st.integers(0, 255)))
    assert bytes(damaged) == whole or parse_state(bytes(damaged)) is None


@pytest.mark.parametrize("content", [b"", b"\x00" * 80, state_text(b"12345", 1).replace(b"boots 1", b"boots 2")])
def test_what_is_no_state_is_none(content: bytes) -> None:
    assert parse_state(content) is None


def test_engine_ids_have_the_form_of_rfc_3411_and_are_never_the_same() -> None:
    made = {new_engine_id(32473) for _ in range(100)}
    assert len(made) == 100
    assert {(each[:4].hex(), each[4], len(each)) for each in made} == {("80007ed9", 5, 17)}


def test_engine_time_is_whole_seconds_since_the_start_and_never_negative() -> None:
    engine = Engine(b"12345", 1, 1000.0)
    assert [engine.time(at) for at in (999.0, 1000.0, 1000.99, 1001.0, 1000.0 + 2**31)] == [0, 0, 0, 1, 2**31]
