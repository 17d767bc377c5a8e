"""Who may do what, and what the log hears of it."""

from __future__ import annotations

from collections import Counter

import pytest

from gateway.core.policy import Audit, Decision, Reason, decide

READABLE = {1: None, 2: None, 3: None, 4: None}
REFUSED_WRITE = Decision(allowed=False, reason=Reason.WRITES_DISABLED)


@pytest.mark.parametrize("function", range(256))
def test_every_function_has_its_decision(function: int) -> None:
    decision = decide(function, READABLE)
    if function in {1, 2, 3, 4, 0x2B}:
        assert decision == Decision(allowed=True, reason=Reason.READ)
    elif function in {5, 6, 15, 16, 22, 23}:
        assert decision == REFUSED_WRITE
    else:
        assert decision == Decision(allowed=False, reason=Reason.UNKNOWN_FUNCTION)


def test_a_function_the_map_does_not_read_with_is_unknown() -> None:
    assert decide(2, {3: None}) == Decision(allowed=False, reason=Reason.UNKNOWN_FUNCTION)


@pytest.mark.parametrize(
    ("pdu", "address"),
    [
        ("06 e012 beef", "0xe012"),
        ("10 0001 0001 02 beef", "0x0001"),
        ("17 0000 0001 e013 0001 02 beef", "0xe013"),
        ("17 0000 0001", "none"),
        ("05 00", "none"),
        ("05", "none"),
    ],
)
def test_the_audit_line_names_the_address_and_not_the_value(pdu: str, address: str) -> None:
    data = bytes.fromhex(pdu)
    line = Audit(Counter()).record(REFUSED_WRITE, "192.0.2.1", 11, data, 0.0)
    assert line == (
        f"event=write_refused peer=192.0.2.1 unit=11 function=0x{data[0]:02x} address={address}"
        " reason=writes_disabled left_out=0"
    )


def test_repeats_are_counted_and_told_later() -> None:
    refused: Counter[str] = Counter()
    audit = Audit(refused)
    write = bytes.fromhex("06 e000 0001")
    lines = [audit.record(REFUSED_WRITE, "a", 1, write, at / 10) for at in range(700)]
    told = [line for line in lines if line is not None]
    assert len(told) == 2
    assert told[1].endswith("left_out=599")
    assert refused == {"writes_disabled": 700}


def test_unknown_functions_are_counted_but_not_told() -> None:
    refused: Counter[str] = Counter()
    assert Audit(refused).record(decide(8, READABLE), "a", 1, b"\x08", 0.0) is None
    assert refused == {"unknown_function": 1}
