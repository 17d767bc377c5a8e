"""Our encodings against pymodbus', for every function we serve."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymodbus.framer import FramerRTU, FramerSocket
from pymodbus.pdu import DecodePDU, ExceptionResponse, ModbusPDU
from pymodbus.pdu.bit_message import (
    ReadCoilsRequest,
    ReadCoilsResponse,
    ReadDiscreteInputsRequest,
    ReadDiscreteInputsResponse,
    WriteSingleCoilRequest,
    WriteSingleCoilResponse,
)
from pymodbus.pdu.mei_message import ReadDeviceInformationRequest, ReadDeviceInformationResponse
from pymodbus.pdu.register_message import (
    ReadHoldingRegistersRequest,
    ReadHoldingRegistersResponse,
    ReadInputRegistersRequest,
    ReadInputRegistersResponse,
    WriteSingleRegisterRequest,
    WriteSingleRegisterResponse,
)

from gateway.modbus.frames import Exchange
from gateway.modbus.mbap import encode
from gateway.modbus.pdu import (
    ReadRequest,
    exception_reply,
    expected_reply_size,
    parse_identification,
    parse_read,
    read_identification_request,
    reply_fits,
)

READS: dict[int, tuple[type[ModbusPDU], type[ModbusPDU], int]] = {
    1: (ReadCoilsRequest, ReadCoilsResponse, 2000),
    2: (ReadDiscreteInputsRequest, ReadDiscreteInputsResponse, 2000),
    3: (ReadHoldingRegistersRequest, ReadHoldingRegistersResponse, 125),
    4: (ReadInputRegistersRequest, ReadInputRegistersResponse, 125),
}


def pdu_of(message: ModbusPDU) -> bytes:
    return bytes((message.function_code,)) + message.encode()


@given(st.sampled_from(sorted(READS)), st.data())
def test_read_requests_and_replies(function: int, data: st.DataObject) -> None:
    request_type, reply_type, limit = READS[function]
    count = data.draw(st.integers(1, limit))
    address = data.draw(st.integers(0, 0x10000 - count))

    request = pdu_of(request_type(address=address, count=count))
    assert ReadRequest(function, address, count).encode() == request
    assert parse_read(request) == ReadRequest(function, address, count)

    if function < 3:
        bits = data.draw(st.integers(0, 2**count - 1))
        reply = pdu_of(reply_type(bits=[bool(bits >> n & 1) for n in range(count)]))
        assert reply[2:] == bits.to_bytes(len(reply) - 2, "little")
    else:
        values = data.draw(st.lists(st.integers(0, 0xFFFF), min_size=count, max_size=count))
        reply = pdu_of(reply_type(registers=values))
        assert reply[2:] == b"".join(value.to_bytes(2, "big") for value in values)
    assert reply_fits(request, reply)
    assert expected_reply_size(request) == len(reply)


@given(st.integers(0, 0xFFFF), st.integers(0, 0xFFFF))
def test_register_writes(address: int, value: int) -> None:
    request = pdu_of(WriteSingleRegisterRequest(address=address, registers=[value]))
    reply = pdu_of(WriteSingleRegisterResponse(address=address, registers=[value]))
    assert reply_fits(request, reply)
    assert expected_reply_size(request) == len(reply)


@given(st.integers(0, 0xFFFF), st.booleans())
def test_coil_writes(address: int, value: bool) -> None:
    request = pdu_of(WriteSingleCoilRequest(address=address, bits=[value]))
    reply = pdu_of(WriteSingleCoilResponse(address=address, bits=[value]))
    assert reply_fits(request, reply)
    assert expected_reply_size(request) == len(reply)


@given(st.integers(0, 255), st.dictionaries(st.integers(0, 6), st.binary(max_size=30), max_size=3))
def test_identification(first: int, objects: dict[int, bytes]) -> None:
    request = pdu_of(ReadDeviceInformationRequest(read_code=1, object_id=first))
    assert read_identification_request(first) == request
    reply = pdu_of(ReadDeviceInformationResponse(read_code=1, information=objects))
    assert reply_fits(request, reply)
    parsed = parse_identification(reply)
    assert (parsed.objects, parsed.more_follows) == (objects, False)


@pytest.mark.parametrize("function", [1, 2, 3, 4, 5, 6, 0x2B])
@pytest.mark.parametrize("code", [1, 2, 3, 4, 6, 0x0A, 0x0B])
def test_exceptions(function: int, code: int) -> None:
    assert exception_reply(function, code) == pdu_of(ExceptionResponse(function, code))


@given(st.integers(1, 247), st.integers(0, 0xFF00), st.integers(1, 125), st.integers(0, 0xFFFF))
def test_frames(address: int, first: int, count: int, tid: int) -> None:
    request = ReadRequest(3, first, count).encode()
    decoder = DecodePDU(is_server=True)
    assert Exchange.of(address, request).sent == FramerRTU(decoder).encode(request, address, 0)
    assert encode(tid, address, request) == FramerSocket(decoder).encode(request, address, tid)
