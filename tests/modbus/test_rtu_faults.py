"""What goes wrong on a serial line, in virtual time; the ids are the rows of the failure catalogue."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from gateway.errors import ReplyCrcError, ReplyMismatch, ReplyTimeout
from gateway.modbus.collector import Echo
from gateway.modbus.crc import append_crc
from gateway.modbus.pdu import read_identification_request
from gateway.modbus.rtu import State
from gateway.modbus.transactions import Failed, Replied
from tests.modbus.virtual_line import QUARANTINE_S, TIMEOUT_S, TIMING, VirtualLine, pdus, read, registers

TURNAROUND_S = 0.02
RIGHT = registers(0x1234, 0x5678)
RIGHT_PDU = RIGHT[1:-2]
MISSED = TIMEOUT_S + TIMING.wire_s(len(RIGHT))  # from the end of our transmission to the deadline


def failed(event: object) -> Failed:
    assert isinstance(event, Failed)
    return event


def replied(event: object) -> Replied:
    assert isinstance(event, Replied)
    return event


def test_f01_late_reply_within_the_quarantine_is_never_an_answer(line: VirtualLine) -> None:
    event = failed(line.ask(read(0), (MISSED + 0.05, registers(1, 1))))
    assert isinstance(event.error, ReplyTimeout)
    assert line.client.state is State.QUARANTINED

    answer = replied(line.ask(read(10), (TURNAROUND_S, registers(2, 2))))

    assert answer.pdu == registers(2, 2)[1:-2]
    assert line.counters.late_bytes == 9
    # the late reply restarted the silence: it ended 50 ms after the failure and 9 characters later
    assert answer.sent_at >= event.at + 0.05 + TIMING.wire_s(9) + QUARANTINE_S


def test_f02_reply_later_than_the_quarantine_is_a_mismatch_and_the_right_one_still_counts(line: VirtualLine) -> None:
    line.ask(read(0, 2))
    answer = replied(line.ask(read(0, 3), (0.01, registers(9, 9)), (0.2, registers(1, 2, 3))))
    assert answer.pdu == registers(1, 2, 3)[1:-2]
    assert line.counters.mismatch == 1


def test_f02_two_late_replies_within_a_minute_double_the_quarantine_up_to_two_seconds(line: VirtualLine) -> None:
    widths = [line.client.quarantine_s(line.now)]
    for _ in range(12):
        event = failed(line.ask(read(0, 3), (0.01, registers(9, 9))))
        assert isinstance(event.error, ReplyMismatch)
        widths.append(line.client.quarantine_s(line.now))
    expected = [0.1, 0.1, 0.2, 0.2, 0.4, 0.4, 0.8, 0.8, 1.6, 1.6, 2.0, 2.0, 2.0]
    assert widths == pytest.approx(expected)
    assert line.client.ready_at(line.now) == pytest.approx(line.now + 2.0)

    line.run(line.now + 59)
    assert line.client.quarantine_s(line.now) == pytest.approx(2.0)
    line.run(line.now + 2)
    assert line.client.quarantine_s(line.now) == pytest.approx(1.0)
    line.run(line.now + 600)
    assert line.client.quarantine_s(line.now) == pytest.approx(0.1)


def test_f02_two_late_replies_on_the_idle_line_double_the_quarantine(line: VirtualLine) -> None:
    for _ in range(2):
        line.ask(read(0), (MISSED + QUARANTINE_S + 0.05, RIGHT))
        line.run(line.now + 1)
    assert line.counters.late_bytes == 2 * len(RIGHT)
    assert line.client.quarantine_s(line.now) == pytest.approx(2 * QUARANTINE_S)


def test_f02_late_replies_that_the_quarantine_catches_do_not_widen_it(line: VirtualLine) -> None:
    for _ in range(5):
        line.ask(read(0), (MISSED + 0.05, RIGHT))
    line.run(line.now + 1)
    assert line.client.quarantine_s(line.now) == pytest.approx(QUARANTINE_S)


def test_f02_late_replies_more_than_a_minute_apart_do_not_widen_it(line: VirtualLine) -> None:
    for _ in range(3):
        line.ask(read(0, 3), (0.01, registers(9, 9)))
        line.run(line.now + 61)
    assert line.client.quarantine_s(line.now) == pytest.approx(QUARANTINE_S)


class SlowDevice:
    """Answers in order, one request at a time, each register with its own address; stalls once."""

    def __init__(self, line: VirtualLine, stall_s: float) -> None:
        self.line = line
        self.free_at = 0.0
        self.stall_s = stall_s

    def read(self, first: int, count: int) -> Replied | Failed:
        heard = self.line.send(read(first, count))
        start = max(heard, self.free_at) + 0.005 + self.stall_s
        self.stall_s = 0.0
        reply = registers(*range(first, first + count))
        self.free_at = start + TIMING.wire_s(len(reply))
        self.line.arrive(start, reply)
        return self.line.finish()


@pytest.mark.parametrize("stall_s", [0.52, 0.56, 0.6, 0.65, 0.7, 0.9, 1.2])
def test_f03_one_late_reply_and_two_hundred_reads_none_wrong(line: VirtualLine, stall_s: float) -> None:
    device = SlowDevice(line, stall_s)
    failures = 0
    for first in range(0, 800, 4):
        while isinstance(event := device.read(first, 4), Failed):
            failures += 1
        assert replied(event).pdu == registers(*range(first, first + 4))[1:-2]
    assert 1 <= failures <= 2


def test_f03_first_reply_after_a_missed_one_is_delivered_but_the_other_cannot_answer_the_next_request(
    line: VirtualLine,
) -> None:
    line.ask(read(0))
    ended = TURNAROUND_S + TIMING.wire_s(len(RIGHT))
    first = replied(line.ask(read(0), (TURNAROUND_S, RIGHT), (ended + 0.02, RIGHT)))
    assert first.pdu == RIGHT_PDU
    assert line.client.state is State.QUARANTINED

    other = replied(line.ask(read(50), (TURNAROUND_S, registers(5, 5))))

    assert other.pdu == registers(5, 5)[1:-2]
    assert line.counters.late_bytes == len(RIGHT)


def test_f03_a_missed_reply_of_one_device_does_not_slow_the_others(line: VirtualLine) -> None:
    line.ask(read(0), address=7)
    answer = replied(line.ask(read(0), (TURNAROUND_S, RIGHT)))
    assert answer.pdu == RIGHT_PDU
    assert line.client.state is State.IDLE


def test_f05_reply_of_another_unit_is_ignored_and_the_right_one_accepted(line: VirtualLine) -> None:
    answer = replied(line.ask(read(0), (TURNAROUND_S, registers(6, 6, address=2)), (0.08, RIGHT)))
    assert answer.pdu == RIGHT_PDU
    assert line.counters.wrong_unit == 1
    assert line.counters.noise_bytes == 0


def test_f05_replies_of_other_units_do_not_prolong_the_wait(line: VirtualLine) -> None:
    event = failed(line.ask(read(0), *((0.1 * n, registers(6, 6, address=2)) for n in range(1, 5))))
    assert isinstance(event.error, ReplyTimeout)
    assert event.at == pytest.approx(event.sent_at + TIMING.wire_s(8) + MISSED)
    assert line.counters.wrong_unit == 4


@pytest.mark.parametrize(
    "pdu", [b"\x11\x02\xab\xff", b"\x10\x00\x01\x00\x02", b"\xab\x01", b"\x2b\x0e\x01\x01\x00\x00\x00"]
)
def test_f05_whatever_another_unit_says_is_recognised(line: VirtualLine, pdu: bytes) -> None:
    failed(line.ask(read(0), (TURNAROUND_S, append_crc(b"\x02" + pdu))))
    assert line.counters.wrong_unit == 1
    assert line.counters.noise_bytes == line.counters.crc_errors == 0


def test_f06_wrong_unit_and_right_frame_in_one_read(line: VirtualLine) -> None:
    answer = replied(line.ask(read(0), (TURNAROUND_S, registers(6, 6, address=2) + RIGHT)))
    assert answer.pdu == RIGHT_PDU
    assert line.counters.wrong_unit == 1


@pytest.mark.parametrize("size", [1, 2, 3, 5, 9, 17, 100, 255, 256, 257, 300])
@pytest.mark.parametrize(
    "pattern",
    [b"\x00", b"\xff", b"\x01", b"\x01\x03", b"\x01\x03\x04", b"\x01\x83", b"AT\r", RIGHT[:-1]],
    ids=["zeros", "ones", "unit", "unit-function", "head", "exception-head", "modem", "cut-reply"],
)
def test_f07_frame_is_found_behind_noise(line: VirtualLine, size: int, pattern: bytes) -> None:
    noise = (pattern * size)[:size]
    answer = replied(line.ask(read(0), (TURNAROUND_S, noise + RIGHT)))
    assert answer.pdu == RIGHT_PDU
    assert line.client.state is State.IDLE
    counters = line.counters
    assert counters.noise_bytes + 9 * counters.crc_errors > 0
    assert counters.wrong_unit == counters.mismatch == counters.late_bytes == 0


def test_f07_a_flood_of_noise_is_counted_whole_and_ends_as_a_time_out(line: VirtualLine) -> None:
    line.send(read(0))
    for _ in range(50):
        assert line.client.receive(b"\x01\x03\x00" * 100, line.now) is None
    assert isinstance(failed(line.finish()).error, ReplyTimeout)
    assert line.counters.noise_bytes == 15_000


def test_f08_bytes_after_the_frame_start_no_phantom_and_restart_the_silence(line: VirtualLine) -> None:
    answer = replied(line.ask(read(0), (TURNAROUND_S, RIGHT + RIGHT[:5])))
    assert answer.pdu == RIGHT_PDU
    line.run(line.now + TIMING.wire_s(5) + 0.016)
    assert line.counters.late_bytes == 5
    last_byte = line.now
    assert line.client.ready_at(0.0) <= last_byte + TIMING.gap_s

    # what followed is not the beginning of the next reply
    event = failed(line.ask(read(0), (TURNAROUND_S, RIGHT[5:])))
    assert isinstance(event.error, ReplyTimeout)


def test_f08_the_gap_counts_from_the_trailing_bytes(line: VirtualLine) -> None:
    line.client.send(1, read(0), line.now, TIMEOUT_S)
    assert replied(line.client.receive(RIGHT + b"\x00\x00", line.now + 0.1)).pdu == RIGHT_PDU
    assert line.client.receive(b"\x00", line.now + 0.15) is None
    assert line.client.ready_at(line.now) == pytest.approx(line.now + 0.15 + TIMING.gap_s)
    assert line.counters.late_bytes == 3


def flip(frame: bytes, at: int) -> bytes:
    return frame[:at] + bytes((frame[at] ^ 0x10,)) + frame[at + 1 :]


@pytest.mark.parametrize("at", range(3, 9))
def test_f10_bad_crc_fails_as_soon_as_the_line_is_silent(line: VirtualLine, at: int) -> None:
    event = failed(line.ask(read(0), (TURNAROUND_S, flip(RIGHT, at))))
    assert isinstance(event.error, ReplyCrcError)
    assert line.counters.crc_errors == 1
    assert line.counters.noise_bytes == 0
    assert event.at < event.sent_at + TIMING.wire_s(8 + 9) + TURNAROUND_S + 0.016 + 0.03
    assert line.client.state is State.QUARANTINED


@pytest.mark.parametrize("at", range(3))
def test_f10_bad_crc_with_a_damaged_head_fails_at_the_deadline(line: VirtualLine, at: int) -> None:
    event = failed(line.ask(read(0), (TURNAROUND_S, flip(RIGHT, at))))
    assert isinstance(event.error, ReplyCrcError)
    assert line.counters.crc_errors == 1
    assert event.at == pytest.approx(event.sent_at + TIMING.wire_s(8) + MISSED)


def test_f10_damaged_exception_reply(line: VirtualLine) -> None:
    event = failed(line.ask(read(0), (TURNAROUND_S, flip(append_crc(b"\x01\x83\x02"), 4))))
    assert isinstance(event.error, ReplyCrcError)
    assert line.counters.crc_errors == 1


def test_f10_a_pause_inside_a_frame_is_not_its_end(line: VirtualLine) -> None:
    damaged = flip(RIGHT, 4)
    event = line.ask(read(0), (TURNAROUND_S, damaged), (TURNAROUND_S + TIMING.wire_s(9) + 0.01, RIGHT))
    assert replied(event).pdu == RIGHT_PDU
    assert line.counters.crc_errors == 1


STRANGERS: dict[str, bytes] = {
    "another function": registers(1, 2, function=4),
    "exception of another function": append_crc(b"\x01\x84\x02"),
    "exception code 0": append_crc(b"\x01\x83\x00"),
    "a function we do not know": append_crc(b"\x01\x11\x04\x01\x02\x03\x04"),
    "too few registers": registers(1),
    "too many registers": registers(1, 2, 3),
    "byte count over what follows": append_crc(b"\x01\x03\x06\x01\x02\x03\x04"),
    "byte count under what follows": append_crc(b"\x01\x03\x02\x01\x02\x03\x04"),
    "byte count odd": append_crc(b"\x01\x03\x05\x01\x02\x03\x04\x05"),
}


@pytest.mark.parametrize("frame", STRANGERS.values(), ids=STRANGERS)
def test_f11_f12_right_crc_but_not_the_answer_is_a_mismatch(line: VirtualLine, frame: bytes) -> None:
    event = failed(line.ask(read(0), (TURNAROUND_S, frame)))
    assert isinstance(event.error, ReplyMismatch)
    assert event.at == pytest.approx(event.sent_at + TIMING.wire_s(8) + MISSED)
    assert line.counters.mismatch == 1
    assert line.counters.noise_bytes == line.counters.crc_errors == 0
    assert line.client.state is State.QUARANTINED


def test_f11_the_right_reply_after_a_stranger_is_not_thrown_away(line: VirtualLine) -> None:
    answer = line.ask(read(0), (TURNAROUND_S, STRANGERS["another function"]), (0.3, RIGHT))
    assert replied(answer).pdu == RIGHT_PDU
    assert line.counters.mismatch == 1


@pytest.mark.parametrize("address", [1, 2, 17, 247])
@pytest.mark.parametrize("gap_s", [0.0, 0.02], ids=["joined", "apart"])
def test_f13_local_echo_on_reads_needs_no_configuration(line: VirtualLine, address: int, gap_s: float) -> None:
    request = read(0)
    echo = append_crc(bytes((address,)) + request)
    for turn in range(3):
        reply = registers(turn, turn, address=address)
        answer = line.ask(request, (-TIMING.wire_s(8), echo), (gap_s, reply), address=address)
        assert replied(answer).pdu == reply[1:-2]
        line.run(line.now + 0.1)
    assert line.client.echo is Echo.PRESENT
    assert line.counters.echoes == 3
    assert line.counters.noise_bytes == line.counters.late_bytes == 0


def test_f13_echo_of_an_identification_request(line: VirtualLine) -> None:
    request = read_identification_request()
    reply = append_crc(b"\x01\x2b\x0e\x01\x01\x00\x00\x01\x00\x02hi")
    answer = line.ask(request, (-TIMING.wire_s(7), append_crc(b"\x01" + request)), (TURNAROUND_S, reply))
    assert replied(answer).pdu == reply[1:-2]
    assert line.client.echo is Echo.PRESENT


def test_f13_echo_without_a_device_is_a_time_out(line: VirtualLine) -> None:
    event = failed(line.ask(read(0), (-TIMING.wire_s(8), append_crc(b"\x01" + read(0)))))
    assert isinstance(event.error, ReplyTimeout)
    assert line.client.echo is Echo.PRESENT
    assert line.counters.noise_bytes == 0


WRITES = {"05": b"\x05\x00\x01\xff\x00", "06": b"\x06\x00\x01\x00\x03"}


def learn_echo(line: VirtualLine, *, echo: bool) -> None:
    sent = append_crc(b"\x01" + read(0))
    line.ask(read(0), (-TIMING.wire_s(8), sent if echo else b""), (TURNAROUND_S, RIGHT))
    assert line.client.echo is (Echo.PRESENT if echo else Echo.ABSENT)
    line.run(line.now + 0.1)


@pytest.mark.parametrize("pdu", WRITES.values(), ids=WRITES)
@pytest.mark.parametrize("known", [True, False], ids=["echo known", "echo unknown"])
def test_f14_with_echo_one_copy_is_consumed_and_a_silent_device_is_no_success(
    line: VirtualLine, pdu: bytes, known: bool
) -> None:
    if known:
        learn_echo(line, echo=True)
    frame = append_crc(b"\x01" + pdu)

    lone = failed(line.ask(pdu, (-TIMING.wire_s(8), frame)))
    assert isinstance(lone.error, ReplyTimeout)
    assert line.client.echo is (Echo.PRESENT if known else Echo.UNKNOWN)

    both = replied(line.ask(pdu, (-TIMING.wire_s(8), frame), (TURNAROUND_S, frame)))
    assert both.pdu == pdu
    assert line.client.echo is Echo.PRESENT


@pytest.mark.parametrize("pdu", WRITES.values(), ids=WRITES)
def test_f14_without_echo_the_only_copy_is_the_reply(line: VirtualLine, pdu: bytes) -> None:
    learn_echo(line, echo=False)
    answer = replied(line.ask(pdu, (TURNAROUND_S, append_crc(b"\x01" + pdu))))
    assert answer.pdu == pdu
    assert line.counters.echoes == 0


@pytest.mark.parametrize("pdu", WRITES.values(), ids=WRITES)
def test_f14_exception_behind_an_echo(line: VirtualLine, pdu: bytes) -> None:
    refusal = bytes((pdu[0] | 0x80, 2))
    frame = append_crc(b"\x01" + pdu)
    answer = line.ask(pdu, (-TIMING.wire_s(8), frame), (TURNAROUND_S, append_crc(b"\x01" + refusal)))
    assert replied(answer).pdu == refusal
    assert line.client.echo is Echo.PRESENT
    assert line.counters.echoes == 1


def test_f14_a_damaged_echo_does_not_prove_that_there_is_none(line: VirtualLine) -> None:
    damaged = flip(append_crc(b"\x01" + read(0)), 4)
    assert replied(line.ask(read(0), (-TIMING.wire_s(8), damaged), (TURNAROUND_S, RIGHT))).pdu == RIGHT_PDU
    assert line.client.echo is Echo.UNKNOWN


def test_f14_echo_that_vanishes_must_be_learnt_anew(line: VirtualLine) -> None:
    learn_echo(line, echo=True)
    states = []
    for _ in range(2):
        line.ask(read(0), (TURNAROUND_S, RIGHT))
        states.append(line.client.echo)
    assert states == [Echo.UNKNOWN, Echo.ABSENT]


def test_f14_coil_read_whose_reply_equals_its_request_is_treated_as_a_write(line: VirtualLine) -> None:
    request = read(0x0305, 24, function=1)
    frame = append_crc(b"\x01" + request)  # 01 01 03 05 00 18: also a reply of three bytes of coils
    assert isinstance(failed(line.ask(request, (-TIMING.wire_s(8), frame))).error, ReplyTimeout)
    assert replied(line.ask(request, (-TIMING.wire_s(8), frame), (TURNAROUND_S, frame))).pdu == request


@pytest.mark.parametrize("size", range(1, len(RIGHT)))
def test_f15_cut_reply_fails_at_the_deadline_and_leaves_nothing_behind(line: VirtualLine, size: int) -> None:
    event = failed(line.ask(read(0), (TURNAROUND_S, RIGHT[:size])))
    assert isinstance(event.error, ReplyTimeout)
    assert event.at == pytest.approx(event.sent_at + TIMING.wire_s(8) + MISSED)
    answer = line.ask(read(20), (TURNAROUND_S, registers(7, 7)))
    assert replied(answer).pdu == registers(7, 7)[1:-2]


@pytest.mark.parametrize(
    "corrupt",
    [lambda frame: b"\xff\x00" + frame, lambda frame: registers(1, address=9) + frame, lambda frame: frame + b"\x00"],
    ids=["noise", "wrong unit", "trailing"],
)
def test_f09_every_cut_gives_the_same_events(corrupt: Callable[[bytes], bytes], line: VirtualLine) -> None:
    line.ask(read(0), (TURNAROUND_S, corrupt(RIGHT)))
    line.ask(read(0), (TURNAROUND_S, corrupt(flip(RIGHT, 5))))
    line.run(line.now + 1)
    assert pdus(line.events) == [RIGHT_PDU, "crc"]


def receive_at_once(line: VirtualLine, data: bytes, pieces: int) -> Replied:
    """Hand over a stream at one moment, in reads of that many bytes."""
    reads = [data[at : at + pieces] for at in range(0, len(data), pieces)]
    (event,) = [event for part in reads if (event := line.client.receive(part, line.now)) is not None]
    return replied(event)


@pytest.mark.parametrize("pieces", [1, 7, 10_000])
def test_f09_of_two_nested_frames_the_one_complete_first_wins_in_every_cut(line: VirtualLine, pieces: int) -> None:
    refusal = append_crc(b"\x01\x83\x06")
    outer = registers(0x0000, *(int.from_bytes((refusal + b"\x00")[at : at + 2], "big") for at in (0, 2, 4)), 0, 0, 0)
    line.send(read(0, 7))
    assert receive_at_once(line, outer, pieces).pdu == b"\x83\x06"


@pytest.mark.parametrize("pieces", [1, 7, 10_000])
def test_f07_a_long_frame_of_another_unit_across_the_edge_of_a_full_buffer(line: VirtualLine, pieces: int) -> None:
    other = registers(*range(100), address=2)
    line.send(read(0))
    assert receive_at_once(line, bytes(400) + other + bytes(100) + RIGHT, pieces).pdu == RIGHT_PDU
    assert line.counters.wrong_unit == 1
    assert line.counters.noise_bytes == 500


@pytest.mark.parametrize("pieces", [1, 7, 10_000])
def test_f14_echo_and_reply_on_either_side_of_a_full_buffer(line: VirtualLine, pieces: int) -> None:
    pdu = WRITES["06"]
    frame = append_crc(b"\x01" + pdu)
    line.send(pdu)
    assert receive_at_once(line, bytes(400) + frame + bytes(200) + frame, pieces).pdu == pdu
    assert line.counters.echoes == 1
    assert line.counters.noise_bytes == 600
