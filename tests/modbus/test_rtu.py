"""The rules of the RTU client that need no fault."""

from __future__ import annotations

import math

import pytest

from gateway.errors import IllegalDataAddress, IllegalDataValue, IllegalFunction, RequestError
from gateway.modbus.collector import Echo
from gateway.modbus.counters import RtuCounters
from gateway.modbus.crc import append_crc
from gateway.modbus.pdu import read_identification_request
from gateway.modbus.rtu import RtuClient, State, Timing
from gateway.modbus.transactions import Failed, Replied
from tests.modbus.virtual_line import TIMING, read, registers

REPLY = registers(1, 2)


def state(client: RtuClient) -> State:
    """The state by a call, which mypy does not take for constant."""
    return client.state


@pytest.fixture
def client() -> RtuClient:
    return RtuClient(TIMING, RtuCounters(), quarantine_s=0.1)


@pytest.mark.parametrize(
    ("setting", "bits"),
    [((9600, 8, "N", 2), 11), ((9600, 8, "E", 1), 11), ((9600, 8, "N", 1), 10), ((9600, 7, "O", 1.5), 10.5)],
)
def test_character_time(setting: tuple[int, int, str, float], bits: float) -> None:
    timing = Timing.of(*setting)
    assert timing.char_s == pytest.approx(bits / 9600)
    assert timing.gap_s == pytest.approx(3.5 * bits / 9600)
    assert timing.wire_s(82 * 2 + 5) == pytest.approx(169 * bits / 9600)


@pytest.mark.parametrize(("baudrate", "gap_s"), [(19200, 3.5 * 11 / 19200), (38400, 0.00175), (115200, 0.00175)])
def test_gap_is_fixed_above_19200_baud(baudrate: int, gap_s: float) -> None:
    assert Timing.of(baudrate, 8, "E", 1).gap_s == pytest.approx(gap_s)


def test_a_transaction(client: RtuClient) -> None:
    assert client.ready_at(5.0) == 5.0
    assert client.next_deadline() is None
    assert client.send(1, read(), 5.0, 0.5) == append_crc(b"\x01" + read())
    assert state(client) is State.WAITING
    assert client.ready_at(5.1) == math.inf
    assert client.receive(REPLY, 5.1) == Replied(REPLY[1:-2], 5.0, 5.1)
    assert state(client) is State.IDLE
    assert client.ready_at(5.1) == pytest.approx(5.1 + TIMING.gap_s)
    assert client.ready_at(6.0) == 6.0


def test_exception_of_this_function_is_a_reply(client: RtuClient) -> None:
    client.send(1, read(), 0.0, 0.5)
    assert client.receive(append_crc(b"\x01\x83\x02"), 0.1) == Replied(b"\x83\x02", 0.0, 0.1)


def test_gap_counts_from_the_end_of_our_own_transmission(client: RtuClient) -> None:
    client.send(1, read(), 0.0, 0.5)
    assert isinstance(client.receive(REPLY, 0.001), Replied)  # a port that is faster than its setting
    assert client.ready_at(0.001) == pytest.approx(TIMING.wire_s(8) + TIMING.gap_s)


def test_deadline_leaves_the_reply_its_time_on_the_wire(client: RtuClient) -> None:
    client.send(1, read(0, 82), 0.0, 0.5)
    deadline = TIMING.wire_s(8) + 0.5 + TIMING.wire_s(169)
    assert client.next_deadline() == pytest.approx(deadline)
    assert client.on_timer(deadline - 0.001) is None
    failed = client.on_timer(deadline)
    assert isinstance(failed, Failed)
    assert (failed.sent_at, failed.at, failed.error.label) == (0.0, deadline, "timeout")
    assert str(failed.error) == "no reply of address 1 within 0.5 s"


def test_deadline_of_an_identification_is_that_of_the_longest_frame(client: RtuClient) -> None:
    client.send(1, read_identification_request(), 0.0, 0.5)
    assert client.next_deadline() == pytest.approx(TIMING.wire_s(7) + 0.5 + TIMING.wire_s(256))


def test_reply_handed_in_late_by_a_busy_loop_still_counts(client: RtuClient) -> None:
    client.send(1, read(), 0.0, 0.5)
    assert isinstance(client.receive(REPLY, 3.0), Replied)


def test_quarantine_ends_after_its_silence(client: RtuClient) -> None:
    client.send(1, read(), 0.0, 0.5)
    client.on_timer(1.0)
    assert state(client) is State.QUARANTINED
    assert client.next_deadline() == pytest.approx(1.1)
    client.receive(b"x", 1.05)
    assert client.next_deadline() == client.ready_at(1.05) == pytest.approx(1.15)
    client.on_timer(1.1)
    assert state(client) is State.QUARANTINED
    client.on_timer(client.ready_at(1.1))
    assert state(client) is State.IDLE


def test_quarantine_is_never_shorter_than_the_gap() -> None:
    client = RtuClient(TIMING, RtuCounters(), quarantine_s=0.0)
    client.send(1, read(), 0.0, 0.5)
    client.on_timer(1.0)
    assert client.ready_at(1.0) == pytest.approx(1.0 + TIMING.gap_s)


def test_bytes_while_nobody_waits_are_late_and_restart_the_silence(client: RtuClient) -> None:
    counters = RtuCounters()
    client = RtuClient(TIMING, counters, quarantine_s=0.1)
    assert client.receive(REPLY, 1.0) is None
    assert counters.late_bytes == len(REPLY)
    assert client.ready_at(1.0) == pytest.approx(1.0 + TIMING.gap_s)
    client.send(1, read(), 2.0, 0.5)
    assert client.on_timer(4.0) is not None  # the frame that came before the request answers nothing


def test_no_bytes_change_nothing(client: RtuClient) -> None:
    assert client.receive(b"", 1.0) is None
    assert client.ready_at(0.0) == 0.0


@pytest.mark.parametrize(
    ("address", "pdu", "error"),
    [
        (0, read(), ValueError),
        (248, read(), ValueError),
        (-1, read(), ValueError),
        (1, b"", IllegalDataValue),
        (1, b"\x03\x00\x00\x00", IllegalDataValue),
        (1, b"\x03\x00\x00\x00\x7e", IllegalDataValue),
        (1, b"\x03\xff\xff\x00\x02", IllegalDataAddress),
        (1, b"\x10\x00\x00\x00\x01\x02\x00\x00", IllegalFunction),
        (1, b"\x2b\x0d\x01\x00", IllegalFunction),
        (1, b"\x05\x00\x00\x12\x34", IllegalDataValue),
        (1, b"\x06\x00\x00", IllegalDataValue),
    ],
)
def test_what_is_not_sent_changes_nothing(client: RtuClient, address: int, pdu: bytes, error: type[Exception]) -> None:
    with pytest.raises(error) as caught:
        client.send(address, pdu, 0.0, 0.5)
    assert isinstance(caught.value, (RequestError, ValueError))
    assert state(client) is State.IDLE
    assert client.ready_at(0.0) == 0.0


def test_sending_too_early_is_refused(client: RtuClient) -> None:
    client.send(1, read(), 0.0, 0.5)
    with pytest.raises(RuntimeError, match="not free"):
        client.send(1, read(), 0.1, 0.5)
    client.receive(REPLY, 0.1)
    with pytest.raises(RuntimeError, match="not free"):
        client.send(1, read(), 0.1 + TIMING.gap_s / 2, 0.5)
    client.send(1, read(), client.ready_at(0.1), 0.5)


def test_reset_forgets_the_transaction_and_listens(client: RtuClient) -> None:
    client.send(1, read(), 0.0, 0.5)
    client.receive(REPLY[:5], 0.1)
    client.reset(0.2)
    assert client.bytes_due() == 0
    assert client.receive(REPLY[5:], 0.25) is None
    assert client.ready_at(0.25) == pytest.approx(0.35)
    client.send(1, read(), 0.35, 0.5)
    assert isinstance(client.receive(REPLY, 0.4), Replied)


def test_reset_forgets_the_echo(client: RtuClient) -> None:
    client.send(1, read(), 0.0, 0.5)
    client.receive(REPLY, 0.1)
    seen = [client.echo]
    client.reset(1.0)
    seen.append(client.echo)
    assert seen == [Echo.ABSENT, Echo.UNKNOWN]


def due_one_by_one(client: RtuClient, stream: bytes) -> list[int]:
    """Hand over just what is due, as a shell does; gives the size of each read."""
    reads = []
    while (due := client.bytes_due()) and stream:
        reads.append(len(stream[:due]))
        client.receive(stream[:due], 0.1)
        stream = stream[due:]
    return reads


@pytest.mark.parametrize("count", [1, 2, 40, 125])
def test_a_reply_is_due_in_two_reads(client: RtuClient, count: int) -> None:
    client.send(1, read(0, count), 0.0, 0.5)
    assert due_one_by_one(client, registers(*range(count))) == [5, 2 * count]
    assert state(client) is State.IDLE
    assert client.bytes_due() == 0


def test_an_exception_is_due_in_one_read(client: RtuClient) -> None:
    client.send(1, read(), 0.0, 0.5)
    assert due_one_by_one(client, append_crc(b"\x01\x83\x02")) == [5]
    assert state(client) is State.IDLE


def test_an_identification_is_due_as_its_lengths_become_known(client: RtuClient) -> None:
    reply = b"\x2b\x0e\x01\x01\x00\x00\x02\x00\x05hello\x01\x03you"
    client.send(1, read_identification_request(), 0.0, 0.5)
    reads = due_one_by_one(client, append_crc(b"\x01" + reply))
    assert sum(reads) == len(reply) + 3
    assert len(reads) <= 5
    assert state(client) is State.IDLE


def test_an_echo_that_is_known_is_due_with_the_reply(client: RtuClient) -> None:
    frame = client.send(1, read(), 0.0, 0.5)
    client.receive(frame + REPLY, 0.1)
    assert client.echo is Echo.PRESENT
    client.send(1, read(), 1.0, 0.5)
    assert due_one_by_one(client, frame + REPLY) == [13, 4]
    assert state(client) is State.IDLE
