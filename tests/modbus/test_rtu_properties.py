"""Properties of the RTU client over any bytes, cut in any way."""

from __future__ import annotations

from dataclasses import asdict
from itertools import pairwise

from hypothesis import assume, given
from hypothesis import strategies as st

from gateway.modbus.collector import MAX_BUFFER, Collector, Echo
from gateway.modbus.counters import RtuCounters
from gateway.modbus.crc import append_crc, crc_ok
from gateway.modbus.frames import Exchange
from gateway.modbus.pdu import ReadRequest, read_identification_request, reply_fits
from gateway.modbus.rtu import RtuClient, State
from gateway.modbus.transactions import Replied
from tests.modbus.virtual_line import TIMING, Event, pdus

LABELS = {"timeout", "crc", "mismatch"}


@st.composite
def requests(draw: st.DrawFn) -> bytes:
    function = draw(st.sampled_from((1, 2, 3, 4, 5, 6, 0x2B)))
    address = draw(st.one_of(st.integers(0, 0xFF00), st.sampled_from((0, 0x0300, 0x0401))))
    if function == 0x2B:
        return read_identification_request(draw(st.integers(0, 255)))
    if function == 5:
        return b"\x05" + address.to_bytes(2, "big") + draw(st.sampled_from((b"\xff\x00", b"\x00\x00")))
    if function == 6:
        return b"\x06" + address.to_bytes(2, "big") + draw(st.binary(min_size=2, max_size=2))
    count = draw(st.integers(1, 40) if function < 3 else st.integers(1, 12))
    return ReadRequest(function, address, count).encode()


@st.composite
def replies(draw: st.DrawFn, request: bytes) -> bytes:
    """A right reply PDU."""
    if draw(st.booleans()) and draw(st.booleans()):
        return bytes((request[0] | 0x80, draw(st.integers(1, 11))))
    if request[0] in (5, 6):
        return request
    if request[0] == 0x2B:
        texts = draw(st.lists(st.binary(max_size=9), max_size=3))
        objects = b"".join(bytes((number, len(text))) + text for number, text in enumerate(texts))
        return b"\x2b\x0e\x01\x01\x00\x00" + bytes((len(texts),)) + objects
    count = int.from_bytes(request[3:5], "big")
    size = (count + 7) // 8 if request[0] < 3 else 2 * count
    return bytes((request[0], size)) + draw(st.binary(min_size=size, max_size=size))


@st.composite
def pieces(draw: st.DrawFn, address: int, request: bytes) -> bytes:
    """Something that may come over a line while a reply is waited for."""
    right = append_crc(bytes((address,)) + draw(replies(request)))
    other = append_crc(bytes((draw(st.integers(1, 247)),)) + draw(replies(draw(requests()))))
    flipped = bytearray(right)
    flipped[draw(st.integers(0, len(right) - 1))] ^= draw(st.integers(1, 255))
    choices = (
        right,
        append_crc(bytes((address,)) + request),  # echo
        other,
        append_crc(bytes((address,)) + draw(st.binary(min_size=1, max_size=12))),  # nonsense with a right CRC
        bytes(flipped),
        right[: draw(st.integers(0, len(right)))],
        right[: draw(st.integers(1, 3))] * draw(st.integers(1, 100)),  # heads without a body
        draw(st.binary(max_size=40)),
        bytes(draw(st.integers(0, 600))),
    )
    return draw(st.sampled_from(choices))


@st.composite
def streams(draw: st.DrawFn) -> tuple[int, bytes, bytes]:
    """Address, request PDU, and what the line gives."""
    address = draw(st.integers(1, 247))
    request = draw(requests())
    return address, request, b"".join(draw(st.lists(pieces(address, request), max_size=6)))


def cut(data: bytes, at: list[int]) -> list[bytes]:
    edges = [0, *sorted(min(edge, len(data)) for edge in at), len(data)]
    return [data[first:last] for first, last in pairwise(edges)]


def run(address: int, request: bytes, parts: list[bytes], echo: Echo) -> tuple[RtuClient, RtuCounters, list[Event]]:
    """Hand over all parts at one moment, then let the time pass."""
    counters = RtuCounters()
    client = RtuClient(TIMING, counters, quarantine_s=0.1)
    client.echo = echo
    client.send(address, request, 0.0, 0.5)
    events = [event for part in parts if (event := client.receive(part, 0.1)) is not None]
    while client.state is State.WAITING:
        deadline = client.next_deadline()
        assert deadline is not None
        event = client.on_timer(deadline)
        events += [] if event is None else [event]
    return client, counters, events


@given(streams(), st.lists(st.integers(0, 700), max_size=12), st.sampled_from(Echo))
def test_any_split_gives_the_same_events_and_counts(
    stream: tuple[int, bytes, bytes], at: list[int], echo: Echo
) -> None:
    address, request, data = stream
    whole, whole_counters, whole_events = run(address, request, [data], echo)
    for parts in (cut(data, at), [bytes((byte,)) for byte in data]):
        client, counters, events = run(address, request, parts, echo)
        assert pdus(events) == pdus(whole_events)
        assert asdict(counters) == asdict(whole_counters)
        assert (client.state, client.echo) == (whole.state, whole.echo)


@given(streams(), st.sampled_from(Echo))
def test_a_reply_is_in_the_stream_with_right_crc_address_and_shape(
    stream: tuple[int, bytes, bytes], echo: Echo
) -> None:
    address, request, data = stream
    _, _, events = run(address, request, [data], echo)
    assert len(events) == 1
    (event,) = events
    if isinstance(event, Replied):
        frame = append_crc(bytes((address,)) + event.pdu)
        assert frame in data
        assert reply_fits(request, event.pdu)
        if frame == append_crc(bytes((address,)) + request) and echo is not Echo.ABSENT:
            assert data.count(frame) >= 2
    else:
        assert event.error.label in LABELS


@given(streams(), st.binary(max_size=30))
def test_a_right_reply_is_found_whatever_came_before(stream: tuple[int, bytes, bytes], after: bytes) -> None:
    address, request, before = stream
    assume(request[0] not in (5, 6))
    right = append_crc(bytes((address, request[0] | 0x80, 4)))
    _, _, events = run(address, request, [before + right + after], Echo.ABSENT)
    assert isinstance(events[0], Replied)


@given(streams())
def test_every_byte_is_accounted_for(stream: tuple[int, bytes, bytes]) -> None:
    """Noise alone: what is in no frame is counted, byte by byte."""
    address, request, _ = stream
    noise = bytes(300)
    _, counters, events = run(address, request, [noise], Echo.ABSENT)
    assert pdus(events) == ["timeout"]
    assert counters.noise_bytes == 300


@given(streams(), st.lists(st.binary(max_size=400), max_size=8))
def test_the_buffer_is_bounded(stream: tuple[int, bytes, bytes], more: list[bytes]) -> None:
    address, request, data = stream
    collector = Collector(Exchange.of(address, request), Echo.UNKNOWN)
    for part in (data, *more):
        if collector.take(part) is not None:
            break
        assert collector.pending < MAX_BUFFER == 512


@given(streams(), st.data())
def test_a_shell_that_reads_what_is_due_never_waits_for_more_than_a_clean_reply_has(
    stream: tuple[int, bytes, bytes], data: st.DataObject
) -> None:
    address, request, _ = stream
    assume(request[0] not in (5, 6))
    frame = append_crc(bytes((address,)) + data.draw(replies(request)))
    client = RtuClient(TIMING, RtuCounters(), quarantine_s=0.1)
    client.send(address, request, 0.0, 0.5)
    rest = frame
    while client.state is State.WAITING:
        due = client.bytes_due()
        assert 0 < due <= len(rest)
        client.receive(rest[:due], 0.1)
        rest = rest[due:]
    assert not rest


@given(st.integers(1, 247), requests(), st.data())
def test_one_flipped_bit_is_never_delivered(address: int, request: bytes, data: st.DataObject) -> None:
    frame = bytearray(append_crc(bytes((address,)) + data.draw(replies(request))))
    bit = data.draw(st.integers(0, 8 * len(frame) - 1))
    frame[bit // 8] ^= 1 << bit % 8
    assert not crc_ok(frame)
    _, _, events = run(address, request, [bytes(frame)], Echo.ABSENT)
    assert pdus(events)[0] in LABELS
