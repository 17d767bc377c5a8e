"""Who may do what, and what the log hears of it."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from ipaddress import ip_network

import pytest

from gateway.core.policy import Audit, Decision, Reason, decide, plan
from gateway.core.site import Device
from gateway.core.write_ledger import Fate
from gateway.core.write_rules import Range, Requester, WriteRule, WriteRules
from gateway.core.writing import Job, PartResult
from gateway.devices.schema import load_map

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


MAP = load_map("prostar-mppt")
RULES = WriteRules(
    [WriteRule((ip_network("192.0.2.7"),), registers=(Range(0, 0xFFFF),), coils=(Range(0, 2),))],
    Device("array-1", 11, 1, MAP),
)
SCADA = Requester("192.0.2.7")


@pytest.mark.parametrize("function", range(256))
def test_f41_a_rule_lets_writes_go_on_for_whom_it_holds_and_changes_nothing_else(function: int) -> None:
    mine = decide(function, READABLE, RULES, SCADA)
    others = decide(function, READABLE, RULES, Requester("192.0.2.8"))
    nobodys = decide(function, READABLE, RULES)
    if function in {5, 6, 15, 16}:
        assert mine == Decision(allowed=True, reason=Reason.WRITE)
    elif function in {22, 23}:
        assert mine == Decision(allowed=False, reason=Reason.WRITE_FUNCTION)
    else:
        assert mine == others == nobodys == decide(function, READABLE)
        return
    assert others == nobodys == Decision(allowed=False, reason=Reason.NO_WRITE_RULE)


def job(pdu: str, requester: Requester = SCADA) -> Job:
    planned = plan(bytes.fromhex(pdu), RULES, requester, "id")
    assert isinstance(planned, Job)
    return planned


def test_a_write_leaves_a_line_with_everything_that_matters() -> None:
    done = PartResult(job("06 E000 4B64").parts[0], 0x4B00, Fate.WRITTEN)
    assert Audit(Counter()).written(job("06 E000 4B64"), done, 0.0) == (
        "event=write peer=192.0.2.7 unit=11 point=absorption_voltage registers=0xE000 old=0x4B00 new=0x4B64"
        " outcome=written left_out=0"
    )
    by_role = replace(job("05 0001 FF00"), requester=Requester("192.0.2.7", "operator"))
    lost = PartResult(by_role.parts[0], None, Fate.UNKNOWN, "timeout")
    assert Audit(Counter()).written(by_role, lost, 0.0) == (
        'event=write peer=192.0.2.7 role="operator" unit=11 point=load_disconnect_forced coils=0x0001 old=unknown'
        " new=0x0001 outcome=unknown error=timeout left_out=0"
    )


@pytest.mark.parametrize(
    ("pdu", "fate", "told"),
    [
        ("06 E000 4B64", Fate.WRITTEN, 100),
        ("06 E000 4B64", Fate.UNKNOWN, 100),
        ("06 E000 4B64", Fate.UNCHANGED, 2),  # costs the asker nothing, so it may ask for ever
        ("06 E000 4B64", Fate.NOT_SENT, 2),
        ("06 0025 4B00", Fate.WRITTEN, 2),  # slave control
    ],
)
def test_what_a_peer_can_cause_as_often_as_it_likes_is_rationed(pdu: str, fate: Fate, told: int) -> None:
    audit, each = Audit(Counter()), job(pdu)
    lines = [audit.written(each, PartResult(each.parts[0], 1, fate), float(at)) for at in range(100)]
    assert sum(line is not None for line in lines) == told
