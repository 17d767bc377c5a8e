"""Read Device Identification from memory, Modbus application protocol 6.21."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymodbus.pdu.mei_message import ReadDeviceInformationResponse

from gateway.core.identification import identify
from gateway.devices.model import Identification
from gateway.errors import IllegalDataAddress, IllegalDataValue, IllegalFunction
from gateway.modbus.pdu import parse_identification, reply_fits

KNOWN = Identification("Morningstar Corp.", "PS-MPPT-25M", "v01.01.01")
OBJECTS = {0: b"Morningstar Corp.", 1: b"PS-MPPT-25M", 2: b"v01.01.01"}


def request(code: int, number: int) -> bytes:
    return bytes((0x2B, 0x0E, code, number))


@pytest.mark.parametrize("code", [1, 2, 3])
@pytest.mark.parametrize(
    ("start", "numbers"), [(0, (0, 1, 2)), (1, (1, 2)), (2, (2,)), (3, (0, 1, 2)), (255, (0, 1, 2))]
)
def test_stream_access(code: int, start: int, numbers: tuple[int, ...]) -> None:
    reply = identify(request(code, start), KNOWN)
    assert reply is not None
    assert reply[:4] == bytes((0x2B, 0x0E, code, 0x81))
    parsed = parse_identification(reply)
    assert parsed.objects == {number: OBJECTS[number] for number in numbers}
    assert not parsed.more_follows


@pytest.mark.parametrize("number", [0, 1, 2])
def test_individual_access(number: int) -> None:
    reply = identify(request(4, number), KNOWN)
    assert reply is not None
    assert parse_identification(reply).objects == {number: OBJECTS[number]}


@pytest.mark.parametrize("number", [3, 0x7F, 0x80, 0xFF])
def test_individual_access_to_an_object_that_is_not_there(number: int) -> None:
    with pytest.raises(IllegalDataAddress):
        identify(request(4, number), KNOWN)


def test_nothing_known() -> None:
    assert identify(request(1, 0), None) is None


@given(rest=st.binary(max_size=252), known=st.sampled_from((KNOWN, None)))
def test_any_request_is_answered_or_refused(rest: bytes, known: Identification | None) -> None:
    pdu = b"\x2b" + rest
    try:
        reply = identify(pdu, known)
    except (IllegalFunction, IllegalDataAddress, IllegalDataValue):
        return
    assert (reply is None) is (known is None)
    assert reply is None or reply_fits(pdu, reply)


@given(texts=st.lists(st.text(st.characters(max_codepoint=255), max_size=240), min_size=3, max_size=3))
def test_long_texts_never_make_a_pdu_too_long(texts: list[str]) -> None:
    reply = identify(request(1, 0), Identification(*texts))
    assert reply is not None
    parsed = parse_identification(reply)
    assert parsed.more_follows is (sum(len(text) + 2 for text in texts) > 246)
    for number, data in parsed.objects.items():
        assert data == texts[number].encode("latin-1")


@given(st.tuples(*[st.text(st.characters(max_codepoint=255), max_size=244)] * 3), st.integers(0, 2))
def test_the_reply_is_what_pymodbus_makes(texts: tuple[str, str, str], start: int) -> None:
    reply = identify(request(1, start), Identification(*texts))
    objects = {number: text.encode("latin-1") for number, text in enumerate(texts) if number >= start}
    theirs = ReadDeviceInformationResponse(read_code=1, information=objects)
    theirs.conformity = 0x81
    assert reply == b"\x2b" + theirs.encode()
    assert len(reply) <= 253


def test_what_does_not_fit_is_said_to_follow() -> None:
    long = Identification("v" * 200, "p" * 100, "r" * 3)
    first = identify(request(1, 0), long)
    assert first is not None
    parsed = parse_identification(first)
    assert (list(parsed.objects), parsed.more_follows, parsed.next_id) == ([0], True, 1)
    second = identify(request(1, parsed.next_id), long)
    assert second is not None
    assert list(parse_identification(second).objects) == [1, 2]
