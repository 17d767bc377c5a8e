from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymodbus.pdu.mei_message import ReadDeviceInformationResponse

from gateway.errors import IllegalDataAddress, IllegalDataValue, IllegalFunction, ReplyMismatch, RequestError
from gateway.modbus.pdu import (
    Function,
    ReadRequest,
    exception_reply,
    expected_reply_size,
    is_exception,
    least_identification_size,
    parse_identification,
    parse_read,
    read_identification_request,
    reply_fits,
)

IDENTIFICATION = b"\x2b\x0e\x01\x81\x00\x00\x02\x00\x05hello\x01\x03you"


@pytest.mark.parametrize(
    ("pdu", "error"),
    [
        (b"", IllegalDataValue),
        (b"\x03", IllegalDataValue),
        (b"\x03\x00\x00\x00", IllegalDataValue),
        (b"\x03\x00\x00\x00\x01\x00", IllegalDataValue),
        (b"\x03\x00\x00\x00\x00", IllegalDataValue),
        (b"\x03\x00\x00\x00\x7e", IllegalDataValue),
        (b"\x04\x00\x00\xff\xff", IllegalDataValue),
        (b"\x01\x00\x00\x07\xd1", IllegalDataValue),
        (b"\x02\x00\x00\x00\x00", IllegalDataValue),
        (b"\x03\xff\xff\x00\x02", IllegalDataAddress),
        (b"\x01\xff\xff\x00\x02", IllegalDataAddress),
        (b"\x05\x00\x00\xff\x00", IllegalFunction),
        (b"\x2b\x0e\x01\x00", IllegalFunction),
        (b"\x00\x00\x00\x00\x01", IllegalFunction),
        (b"\x83\x00\x00\x00\x01", IllegalFunction),
    ],
)
def test_read_requests_that_are_refused(pdu: bytes, error: type[RequestError]) -> None:
    with pytest.raises(error):
        parse_read(pdu)


@pytest.mark.parametrize(
    ("function", "address", "count", "size"),
    [
        (1, 0, 2000, 252),
        (2, 0xFFFF, 1, 3),
        (1, 0, 8, 3),
        (1, 0, 9, 4),
        (3, 0xFFFF, 1, 4),
        (3, 0xFF83, 125, 252),
        (4, 0, 125, 252),
    ],
)
def test_largest_and_last_reads(function: int, address: int, count: int, size: int) -> None:
    request = ReadRequest(function, address, count)
    assert parse_read(request.encode()) == request
    assert request.reply_size == expected_reply_size(request.encode()) == size


@given(
    st.dictionaries(st.integers(0, 255), st.binary(max_size=20), max_size=8),
    st.sampled_from((0, 0xFF)),
    st.integers(0, 255),
)
def test_objects_are_those_that_pymodbus_reads(objects: dict[int, bytes], more: int, following: int) -> None:
    written = b"".join(bytes((number, len(text))) + text for number, text in objects.items())
    reply = bytes((0x2B, 0x0E, 1, 1, more, following, len(objects))) + written
    theirs = ReadDeviceInformationResponse()
    theirs.decode(reply[1:])
    parsed = parse_identification(reply)
    assert (parsed.objects, parsed.more_follows, parsed.next_id) == (theirs.information, more == 0xFF, following)
    assert objects == theirs.information


@given(st.binary(max_size=12))
def test_any_bytes_are_a_read_or_one_of_three_errors(pdu: bytes) -> None:
    try:
        request = parse_read(pdu)
    except (IllegalFunction, IllegalDataValue, IllegalDataAddress):
        return
    assert request.encode() == pdu


@given(st.binary(max_size=12), st.binary(max_size=260))
def test_any_bytes_fit_or_not_or_the_request_is_refused(request: bytes, reply: bytes) -> None:
    try:
        fits = reply_fits(request, reply)
    except (IllegalFunction, IllegalDataValue, IllegalDataAddress):
        with pytest.raises(RequestError):
            expected_reply_size(request)
        return
    assert not fits or reply[0] & 0x7F == request[0]


def test_exceptions() -> None:
    assert exception_reply(3, 2) == b"\x83\x02"
    assert is_exception(b"\x83\x02")
    assert not is_exception(b"\x03\x02\x00\x00")
    assert not is_exception(b"")


READ_2 = b"\x03\x00\x10\x00\x02"
COILS_9 = b"\x01\x00\x00\x00\x09"
WRITE_COIL = b"\x05\x00\x01\xff\x00"
WRITE_REGISTER = b"\x06\x00\x01\x00\x03"
IDENTIFY = b"\x2b\x0e\x01\x00"
IDENTIFY_ONE = b"\x2b\x0e\x04\x01"


@pytest.mark.parametrize(
    ("request_pdu", "reply", "fits"),
    [
        (READ_2, b"\x03\x04abcd", True),
        (READ_2, b"\x03\x04abc", False),
        (READ_2, b"\x03\x04abcde", False),
        (READ_2, b"\x03\x02abcd", False),
        (READ_2, b"\x03\x02ab", False),
        (READ_2, b"\x04\x04abcd", False),
        (READ_2, b"\x83\x02", True),
        (READ_2, b"\x83\x00", False),
        (READ_2, b"\x83", False),
        (READ_2, b"\x83\x02\x00", False),
        (READ_2, b"\x84\x02", False),
        (READ_2, b"", False),
        (COILS_9, b"\x01\x02\xff\x01", True),
        (COILS_9, b"\x01\x01\xff", False),
        (COILS_9, b"\x01\x12\xff\x01", False),
        (WRITE_COIL, WRITE_COIL, True),
        (WRITE_COIL, b"\x05\x00\x01\x00\x00", False),
        (WRITE_COIL, b"\x05\x00\x02\xff\x00", False),
        (WRITE_COIL, b"\x85\x03", True),
        (WRITE_REGISTER, WRITE_REGISTER, True),
        (WRITE_REGISTER, WRITE_REGISTER + b"\x00", False),
        (WRITE_REGISTER, b"\x06\x00\x01\x00\x04", False),
        (IDENTIFY, IDENTIFICATION, True),
        (IDENTIFY, b"\xab\x01", True),
        (IDENTIFY, IDENTIFICATION[:-1], False),
        (IDENTIFY, IDENTIFICATION + b"\x00", False),
        (IDENTIFY, b"\x2b\x0e\x01\x01\x00\x00\x00", True),
        (IDENTIFY, b"\x2b\x0e\x02\x01\x00\x00\x00", False),  # another access than asked for
        (IDENTIFY, b"\x2b\x0d\x01\x01\x00\x00\x00", False),
        (IDENTIFY, b"\x2b\x0e\x01\x01\x01\x00\x00", False),  # more follows is 00 or FF
        (IDENTIFY, b"\x2b\x0e\x01\x01\x00\x00\x02\x00\x01a\x00\x01b", False),  # one object twice
        (IDENTIFY, b"\x2b\x0e\x01\x01\x00\x00\x01\x00\xff" + bytes(255), False),  # over 253 bytes
        (IDENTIFY_ONE, b"\x2b\x0e\x04\x81\x00\x00\x01\x01\x01a", True),
        (IDENTIFY_ONE, b"\x2b\x0e\x04\x81\x00\x00\x01\x02\x01a", False),
        (IDENTIFY_ONE, b"\x2b\x0e\x04\x81\x00\x00\x00", False),
    ],
)
def test_shape_of_replies(request_pdu: bytes, reply: bytes, fits: bool) -> None:
    assert reply_fits(request_pdu, reply) is fits


@pytest.mark.parametrize(
    ("request_pdu", "error"),
    [
        (b"", IllegalDataValue),
        (b"\x2b", IllegalDataValue),
        (b"\x2b\x0d\x01\x00", IllegalFunction),
        (b"\x2b\x0e\x00\x00", IllegalDataValue),
        (b"\x2b\x0e\x05\x00", IllegalDataValue),
        (b"\x2b\x0e\x01\x00\x00", IllegalDataValue),
        (b"\x05\x00\x00\xff\x01", IllegalDataValue),
        (b"\x06\x00\x00\xff", IllegalDataValue),
        (b"\x0f\x00\x00\x00\x01\x01\x01", IllegalFunction),
    ],
)
def test_requests_we_do_not_speak(request_pdu: bytes, error: type[RequestError]) -> None:
    with pytest.raises(error):
        expected_reply_size(request_pdu)


def test_identification() -> None:
    assert read_identification_request() == IDENTIFY
    assert read_identification_request(2) == b"\x2b\x0e\x01\x02"
    assert expected_reply_size(IDENTIFY) is None
    reply = parse_identification(IDENTIFICATION)
    assert reply.objects == {0: b"hello", 1: b"you"}
    assert (reply.more_follows, reply.next_id) == (False, 0)


def test_identification_to_be_continued() -> None:
    reply = parse_identification(b"\x2b\x0e\x01\x01\xff\x02\x01\x00\x00")
    assert reply.objects == {0: b""}
    assert (reply.more_follows, reply.next_id) == (True, 2)


@given(st.one_of(st.binary(max_size=260), st.binary(max_size=60).map(lambda tail: b"\x2b\x0e\x01\x01\x00\x00" + tail)))
def test_any_bytes_are_an_identification_or_a_mismatch(reply: bytes) -> None:
    try:
        parsed = parse_identification(reply)
    except ReplyMismatch:
        assert not reply_fits(IDENTIFY, reply) or is_exception(reply)
        return
    assert sum(2 + len(value) for value in parsed.objects.values()) == len(reply) - 7


@given(st.lists(st.binary(max_size=20), max_size=8), st.binary(max_size=10))
def test_least_identification_size_grows_to_the_size(texts: list[bytes], after: bytes) -> None:
    objects = b"".join(bytes((number, len(text))) + text for number, text in enumerate(texts))
    reply = b"\x2b\x0e\x01\x01\x00\x00" + bytes((len(texts),)) + objects
    sizes = [least_identification_size(reply[:cut]) for cut in range(len(reply) + 1)]
    assert sizes == sorted(sizes)
    assert all(size > cut for cut, size in enumerate(sizes[:-1]))
    assert sizes[-1] == least_identification_size(reply + after) == len(reply)


def test_functions_are_those_of_the_device() -> None:
    assert [int(function) for function in Function] == [1, 2, 3, 4, 5, 6, 0x2B]
