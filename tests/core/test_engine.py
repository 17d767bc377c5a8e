"""The line engine against simulated controllers in virtual time."""

from __future__ import annotations

import itertools
import logging
import math
import struct
import time
from collections.abc import Callable
from dataclasses import replace

import pytest

from gateway.core.settings import PollSettings
from gateway.core.site import LineState, Outcome
from gateway.core.snapshot import DeviceState
from gateway.errors import (
    DeviceOffline,
    IllegalFunction,
    LineDown,
    QueueFull,
    QueueTimeout,
    ReplyTimeout,
    ReplyUnusable,
    RequestError,
    ShuttingDown,
    Unconfirmed,
)
from gateway.modbus.pdu import Function, ReadRequest
from tests.core.virtual_line import MakeLine, VirtualLine


class Registers:
    """A controller whose register `a` reads `base + a`, with faults at will."""

    def __init__(self, address: int, base: int = 0, turnaround_s: float = 0.015) -> None:
        self.address = address
        self.base = base
        self.turnaround_s = turnaround_s
        self.silent = False
        self.limit = 125
        self.refused: set[int] = set()
        self.exception: int | None = None
        self.asked: list[bytes] = []

    def handle(self, pdu: bytes, now: float) -> bytes | None:
        self.asked.append(pdu)
        if self.silent:
            return None
        function = pdu[0]
        if function == Function.READ_IDENTIFICATION:
            return bytes([function | 0x80, 1])
        _, address, count = struct.unpack(">BHH", pdu)
        if self.exception is not None:
            return bytes([function | 0x80, self.exception])
        if count > self.limit or self.refused.intersection(range(address, address + count)):
            return bytes([function | 0x80, 2])
        if function in {1, 2}:
            return bytes([function, (count + 7) // 8]) + bytes((count + 7) // 8)
        words = [(self.base + register) & 0xFFFF for register in range(address, address + count)]
        return struct.pack(f">BB{count}H", function, 2 * count, *words)


def state(line: VirtualLine) -> DeviceState:
    return line.devices[0].snapshot.state


def registers(address: int, count: int, function: int = Function.READ_HOLDING_REGISTERS) -> bytes:
    return ReadRequest(function, address, count).encode()


def test_a_device_comes_online_with_values_soon_after_the_line_opens(virtual_line: MakeLine) -> None:
    line = virtual_line(Registers(1), Registers(2))
    assert [device.snapshot.state for device in line.devices] == [DeviceState.UNKNOWN] * 2
    line.run(2.0)
    for device in line.devices:
        assert device.snapshot.state is DeviceState.ONLINE
        assert device.snapshot.shown()


def test_values_age_from_the_moment_the_request_went_out(virtual_line: MakeLine) -> None:
    line = virtual_line(Registers(1))
    line.run(0.5)
    block = next(block for block in line.devices[0].snapshot.blocks if block.count == 82)
    sent_at = next(at for at, frame in line.sent if frame[1:6] == registers(0, 82))
    assert block.read_at == sent_at


def test_the_gap_of_three_and_a_half_characters_is_kept(virtual_line: MakeLine) -> None:
    line = virtual_line(Registers(1, turnaround_s=0.0), Registers(2, turnaround_s=0.0), Registers(3))
    line.run(120.0)
    assert line.engine.stats.sent > 300
    assert line.wire.counters.gap_violations == 0


def test_every_transaction_is_accounted_for(virtual_line: MakeLine) -> None:
    dead = Registers(3)
    dead.silent = True
    line = virtual_line(Registers(1), Registers(2), dead)
    line.run(300.0)
    stats = line.engine.stats
    on_wire = stats.sent - stats.ok - sum(stats.failed.values())
    assert on_wire in {0, 1}
    assert stats.failed["timeout"] >= 3
    assert stats.ok > 800


def test_a_client_read_reaches_the_device_and_comes_back_unchanged(virtual_line: MakeLine) -> None:
    line = virtual_line(Registers(1, base=7))
    assert line.ask(line.devices[0], registers(0x100, 2)) == b"\x03\x04" + struct.pack(">HH", 0x107, 0x108)


def test_two_devices_never_get_each_others_reply(virtual_line: MakeLine) -> None:
    line = virtual_line(Registers(1, base=0x1000), Registers(2, base=0x2000))
    outcomes: list[tuple[int, Outcome]] = []

    def answered(index: int) -> Callable[[Outcome], None]:
        def done(outcome: Outcome) -> None:
            outcomes.append((index, outcome))

        return done

    for index, device in enumerate(line.devices * 20):
        line.read(device, registers(index, 1), answered(index))
    line.run(10.0)
    assert len(outcomes) == 40
    for index, got in outcomes:
        base = 0x1000 if index % 2 == 0 else 0x2000
        assert got == b"\x03\x02" + struct.pack(">H", base + index)


def test_the_devices_own_exception_is_passed_through(virtual_line: MakeLine) -> None:
    controller = Registers(1)
    line = virtual_line(controller)
    line.run(1.0)
    controller.exception = 4
    assert line.ask(line.devices[0], registers(0x9999, 1)) == b"\x83\x04"


@pytest.mark.parametrize("pdu", [b"\x06\0\0\0\1", b"\x05\0\0\xff\0", b"\x10\0\0\0\1\2\0\0", b"\x16\0\0\0\0\0\0", b""])
def test_nothing_but_reads_is_ever_sent(virtual_line: MakeLine, pdu: bytes) -> None:
    line = virtual_line(Registers(1))
    assert isinstance(line.ask(line.devices[0], pdu), IllegalFunction)
    assert {frame[1] for _, frame in line.sent} <= {1, 2, 3, 4, 0x2B}


@pytest.mark.parametrize("pdu", [b"\x03", b"\x03\0\0\0\0", b"\x03\xff\xff\0\2", b"\x2b", b"\x2b\x0d\1\0"])
def test_a_read_without_meaning_is_refused_and_the_line_goes_on(virtual_line: MakeLine, pdu: bytes) -> None:
    line = virtual_line(Registers(1))
    line.run(1.0)
    outcome = line.ask(line.devices[0], pdu)
    assert isinstance(outcome, RequestError)
    assert outcome.exception_code in {1, 2, 3}
    assert isinstance(line.ask(line.devices[0], registers(0, 1)), bytes)


def test_identical_reads_cost_one_transaction_and_every_waiter_gets_its_answer(virtual_line: MakeLine) -> None:
    controller = Registers(1)
    line = virtual_line(controller)
    line.run(1.0)
    outcomes: list[Outcome] = []
    for _ in range(5):
        line.read(line.devices[0], registers(0x500, 3), outcomes.append)
    line.run(1.0)
    assert len(outcomes) == 5
    assert len(set(map(bytes, (outcome for outcome in outcomes if isinstance(outcome, bytes))))) == 1
    assert controller.asked.count(registers(0x500, 3)) == 1


def test_a_cancelled_read_is_not_answered_and_does_not_disturb_the_others(virtual_line: MakeLine) -> None:
    line = virtual_line(Registers(1))
    outcomes: list[Outcome] = []
    gone = line.read(line.devices[0], registers(1, 1), lambda _: pytest.fail("it was cancelled"))
    line.read(line.devices[0], registers(1, 1), outcomes.append)
    gone.cancel()
    line.run(1.0)
    assert len(outcomes) == 1


def test_an_outcome_is_never_handed_out_by_submit_itself(virtual_line: MakeLine) -> None:
    line = virtual_line(Registers(1), opened=False)
    outcomes: list[Outcome] = []
    line.read(line.devices[0], registers(0, 1), outcomes.append)
    assert outcomes == []
    line.run(0.1)
    assert len(outcomes) == 1


def test_a_face_that_fails_in_its_callback_does_not_stop_the_line(
    virtual_line: MakeLine, caplog: pytest.LogCaptureFixture
) -> None:
    line = virtual_line(Registers(1))

    def broken(_outcome: Outcome) -> None:
        raise ValueError("a face's own mistake")

    line.read(line.devices[0], registers(0, 1), broken)
    line.run(2.0)
    assert "outcome_handler_failed" in caplog.text
    assert isinstance(line.ask(line.devices[0], registers(5, 1)), bytes)


def test_a_silent_device_costs_a_client_all_its_retries_and_then_ends(virtual_line: MakeLine) -> None:
    controller = Registers(1)
    line = virtual_line(controller, retries=1)
    line.run(1.0)
    controller.silent = True
    controller.asked.clear()
    assert isinstance(line.ask(line.devices[0], registers(0x700, 1)), ReplyTimeout)
    assert controller.asked == [registers(0x700, 1), registers(0, 1, function=1)]  # once more, and first the question


def test_a_silent_device_that_comes_back_answers_a_client_at_its_second_try(virtual_line: MakeLine) -> None:
    controller = Registers(1)
    line = virtual_line(controller, retries=1)
    line.run(1.0)
    controller.silent = True
    controller.asked.clear()
    outcomes: list[Outcome] = []
    line.read(line.devices[0], registers(0x700, 1), outcomes.append)
    line.run(0.6)
    controller.silent = False
    line.run(1.0)
    assert outcomes == [bytes.fromhex("03 02 0700")]
    assert controller.asked[:3] == [registers(0x700, 1), registers(0, 1, function=1), registers(0x700, 1)]


def test_three_misses_take_a_device_offline_and_its_reads_fail_at_once(virtual_line: MakeLine) -> None:
    controller = Registers(1)
    line = virtual_line(controller)
    line.run(1.0)
    controller.silent = True
    line.run(6.0)
    assert state(line) is DeviceState.OFFLINE
    assert not line.devices[0].snapshot.shown()
    before = line.now
    assert isinstance(line.ask(line.devices[0], registers(0, 1)), DeviceOffline)
    assert line.now - before < 0.05


def test_reads_that_wait_when_a_device_goes_offline_end_at_once(virtual_line: MakeLine) -> None:
    dead = Registers(1)
    dead.silent = True
    line = virtual_line(dead, retries=0)
    outcomes: list[Outcome] = []
    for address in range(10):
        line.read(line.devices[0], registers(100 * address, 1), outcomes.append)
    line.run(3.0)
    assert len(outcomes) == 10
    assert sum(isinstance(outcome, DeviceOffline) for outcome in outcomes) >= 7


def test_a_device_that_comes_back_is_online_after_one_probe_and_is_identified_again(virtual_line: MakeLine) -> None:
    controller = Registers(1)
    line = virtual_line(controller)
    line.run(1.0)
    controller.silent = True
    line.run(30.0)
    controller.silent = False
    controller.asked.clear()
    line.run(61.0)
    assert state(line) is DeviceState.ONLINE
    assert any(pdu[0] == Function.READ_IDENTIFICATION for pdu in controller.asked)


def test_a_dead_device_costs_the_others_at_most_one_time_out_a_probe(virtual_line: MakeLine) -> None:
    dead = Registers(3)
    dead.silent = True
    line = virtual_line(Registers(1), Registers(2), dead)
    line.run(30.0)
    line.sent.clear()
    line.run(300.0)
    probes = [at for at, frame in line.sent if frame[0] == 3]
    assert 4 <= len(probes) <= 8  # one a minute, with jitter
    others = [at for at, frame in line.sent if frame[0] != 3]
    longest_s = max(b - a for a, b in itertools.pairwise(others))
    assert longest_s < 1.0 + 0.5 + 0.35  # period + time-out + wire time and quarantine


def test_one_line_in_the_log_for_down_and_one_for_up_with_its_duration(
    virtual_line: MakeLine, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    controller = Registers(1)
    line = virtual_line(controller)
    line.run(1.0)
    caplog.clear()
    controller.silent = True
    line.run(120.0)
    controller.silent = False
    line.run(70.0)
    events = [message for message in caplog.messages if "device=array-1" in message]
    assert ["event=device_offline" in events[0], "event=device_online" in events[-1]] == [True, True]
    assert len(events) == 2
    assert "lasted_s=" in events[1]


def test_a_device_that_answers_only_exceptions_becomes_stale_not_offline(virtual_line: MakeLine) -> None:
    controller = Registers(1)
    line = virtual_line(controller)
    line.run(1.0)
    controller.exception = 4
    line.run(6.0)
    assert state(line) is DeviceState.STALE
    assert not line.devices[0].snapshot.shown()
    controller.exception = None
    line.run(2.0)
    assert state(line) is DeviceState.ONLINE


def test_blocks_that_the_device_refuses_are_split_and_the_split_is_remembered(virtual_line: MakeLine) -> None:
    controller = Registers(1)
    controller.limit = 50
    line = virtual_line(controller)
    line.run(10.0)
    assert state(line) is DeviceState.ONLINE
    live = sorted((b.first, b.count) for b in line.devices[0].snapshot.blocks if b.first < 0x1000 and b.count > 16)
    assert len(live) == 2
    assert sum(count for _, count in live) == 82
    controller.asked.clear()
    line.engine.closed("unplugged", line.now)
    line.engine.opened(line.now)
    line.run(5.0)
    assert not [pdu for pdu in controller.asked if pdu == registers(0, 82)]


def test_a_register_that_the_device_does_not_have_is_left_out_and_the_rest_is_read(virtual_line: MakeLine) -> None:
    controller = Registers(1)
    controller.refused = {0x04}
    line = virtual_line(controller)
    line.run(30.0)
    snapshot = line.devices[0].snapshot
    assert snapshot.state is DeviceState.ONLINE
    read = {address for block in snapshot.blocks for address in range(block.first, block.first + block.count)}
    assert 0x04 not in read
    assert 0x12 in read


def test_a_line_that_goes_down_ends_what_waits_and_makes_its_devices_stale(virtual_line: MakeLine) -> None:
    line = virtual_line(Registers(1))
    line.run(1.0)
    outcomes: list[Outcome] = []
    for address in (1, 2, 3):
        line.read(line.devices[0], registers(address, 1), outcomes.append)
    line.run(0.005)
    line.engine.closed("unplugged", line.now)
    line.run(0.1)
    assert [type(outcome) for outcome in outcomes] == [LineDown] * 3
    assert state(line) is DeviceState.STALE
    assert line.engine.status(line.now).state is LineState.DOWN
    assert line.engine.status(line.now).error == "unplugged"
    assert isinstance(line.ask(line.devices[0], registers(1, 1)), LineDown)
    line.engine.opened(line.now)
    line.run(1.0)
    assert state(line) is DeviceState.ONLINE


def test_a_full_queue_is_busy_at_once(virtual_line: MakeLine) -> None:
    line = virtual_line(Registers(1), queue_limit=3)
    outcomes: list[Outcome] = []
    for address in range(10):
        line.read(line.devices[0], registers(100 * address, 1), outcomes.append)
    line.run(5.0)
    assert sum(isinstance(outcome, QueueFull) for outcome in outcomes) == 7
    assert sum(isinstance(outcome, bytes) for outcome in outcomes) == 3


def test_a_read_that_waits_too_long_ends_as_busy(virtual_line: MakeLine) -> None:
    slow = Registers(1, turnaround_s=0.4)
    line = virtual_line(slow, queue_limit_s=1.0)
    outcomes: list[Outcome] = []
    for address in range(20):
        line.read(line.devices[0], registers(100 * address, 1), outcomes.append)
    line.run(30.0)
    assert len(outcomes) == 20
    assert any(isinstance(outcome, QueueTimeout) for outcome in outcomes)


def test_a_garbled_reply_is_tried_again_and_then_is_unusable_never_delivered(virtual_line: MakeLine) -> None:
    controller = Registers(1)
    line = virtual_line(controller, retries=2)
    line.run(1.0)
    line.wire.corrupt_replies(100)
    outcome = line.ask(line.devices[0], registers(0x321, 4))
    assert isinstance(outcome, ReplyUnusable)
    assert outcome.exception_code == 0x04
    assert line.engine.stats.wire.crc_errors >= 3


def test_polls_keep_their_period_while_a_client_asks_without_end(virtual_line: MakeLine) -> None:
    line = virtual_line(Registers(1))
    line.run(1.0)
    done: list[Outcome] = []

    def again(outcome: Outcome) -> None:
        done.append(outcome)
        line.read(line.devices[0], registers(0x800 + len(done) % 1000, 20), again)

    again(b"")
    line.sent.clear()
    line.run(60.0)
    polls = [at for at, frame in line.sent if frame[1:6] == registers(0, 82)]
    assert len(done) > 200
    assert max(b - a for a, b in itertools.pairwise(polls)) < 2.5


def test_the_use_of_the_line_is_reported(virtual_line: MakeLine) -> None:
    line = virtual_line(Registers(1), Registers(2), Registers(3), Registers(4), Registers(5), Registers(6))
    line.run(120.0)
    use = line.engine.status(line.now).use_ratio
    assert use == pytest.approx(0.98, abs=0.03)  # six full reads a second do not fit: the gaps are what is left
    assert line.engine.stats.busy_s == pytest.approx(120.0 * use, rel=0.05)


def test_a_simulated_hour_of_three_devices_takes_seconds(virtual_line: MakeLine) -> None:
    line = virtual_line(Registers(1), Registers(2), Registers(3))
    begin = time.thread_time()
    line.run(3600.0)
    took_s = time.thread_time() - begin
    stats = line.engine.stats
    assert stats.polls > 3 * 3500
    assert sum(stats.failed.values()) <= 3  # each device refuses identification once, nothing else
    assert all(math.isclose(device.snapshot.last_reply_at or 0.0, line.now, abs_tol=1.5) for device in line.devices)
    assert took_s < 60


def test_a_line_that_stops_ends_the_transaction_on_the_wire_and_refuses_all_else(virtual_line: MakeLine) -> None:
    line = virtual_line(Registers(1, turnaround_s=0.3))
    line.run(10.0)
    outcomes: dict[str, Outcome] = {}
    device = line.devices[0]
    line.read(device, registers(0x100, 2), lambda outcome: outcomes.__setitem__("on the wire", outcome))
    while not any(sent[1][2:4] == b"\x01\x00" for sent in line.sent):
        line.run(0.01)
    line.read(device, registers(0x200, 2), lambda outcome: outcomes.__setitem__("waits", outcome))
    line.engine.finish()
    line.run(0.01)
    assert isinstance(outcomes["waits"], ShuttingDown)
    busy = [line.engine.busy]
    line.read(device, registers(0x300, 2), lambda outcome: outcomes.__setitem__("came later", outcome))
    count = len(line.sent)
    line.run(30.0)
    assert outcomes["on the wire"] == bytes.fromhex("03 04 0100 0101")
    assert isinstance(outcomes["came later"], ShuttingDown)
    assert [*busy, line.engine.busy] == [True, False]
    assert len(line.sent) == count  # no poll either


def test_a_line_that_stops_in_order_is_no_reason_to_warn(
    virtual_line: MakeLine, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    line = virtual_line(Registers(1))
    line.run(10.0)
    line.engine.finish()
    line.run(1.0)
    line.engine.closed("closed", line.now)
    assert line.devices[0].snapshot.state is DeviceState.STALE
    assert [record.levelname for record in caplog.records if "device_stale" in record.getMessage()] == ["INFO"]
    assert 'reason="stopping"' in caplog.text


def test_what_a_stopping_line_cannot_end_is_refused_as_the_rest(virtual_line: MakeLine) -> None:
    station = Registers(1)
    line = virtual_line(station, reply_timeout_s=10.0)
    line.run(10.0)
    station.silent = True
    outcomes: list[Outcome] = []
    line.read(line.devices[0], registers(0x100, 2), outcomes.append)
    while not any(sent[1][2:4] == b"\x01\x00" for sent in line.sent):
        line.run(0.01)
    line.engine.finish()
    line.engine.closed("stopped", line.now)
    line.run(0.01)
    assert [type(outcome) for outcome in outcomes] == [ShuttingDown]


def test_a_write_that_was_sent_is_never_said_not_to_be(virtual_line: MakeLine) -> None:
    """The line stops, and cannot wait until it is answered: 06 or 0A would say that nothing was done."""
    station = Registers(1)
    line = virtual_line(station, reply_timeout_s=10.0, writes=True)
    line.run(10.0)
    station.silent = True
    write, later = bytes.fromhex("06 E000 1234"), bytes.fromhex("06 E001 1234")
    outcomes: list[Outcome] = []
    line.write(line.devices[0], write, outcomes.append)
    while not any(frame[1:-2] == write for _, frame in line.sent):
        line.run(0.01)
    line.write(line.devices[0], later, outcomes.append)
    line.engine.finish()
    line.run(0.01)
    line.engine.closed("stopped", line.now)
    line.run(0.01)
    assert [type(outcome) for outcome in outcomes] == [ShuttingDown, Unconfirmed]
    assert not any(frame[1:-2] == later for _, frame in line.sent)


def test_a_line_that_stops_repeats_nothing(virtual_line: MakeLine) -> None:
    station = Registers(1)
    line = virtual_line(station)
    line.run(10.0)
    station.silent = True
    outcomes: list[Outcome] = []
    line.read(line.devices[0], registers(0x100, 2), outcomes.append)
    count = len(line.sent)
    while len(line.sent) == count:
        line.run(0.01)
    line.engine.finish()
    line.run(30.0)
    assert [type(outcome) for outcome in outcomes] == [ShuttingDown]
    assert len(line.sent) == count + 1


def test_a_line_goes_on_by_other_settings_of_the_same_wire(virtual_line: MakeLine) -> None:
    line = virtual_line(Registers(1), poll=PollSettings(live_s=3600.0, settings_s=3600.0), retries=0)
    line.run(10.0)
    device, before = line.devices[0], len(line.sent)
    snapshot = device.snapshot
    line.run(60.0)
    assert len(line.sent) == before
    new = replace(line.engine.settings, index=2, poll=PollSettings(live_s=1.0, settings_s=3600.0), retries=3)
    assert line.engine.settings.same_wire(new)
    line.engine.adjust(new, line.now)
    assert device.snapshot is snapshot
    line.run(10.0)
    assert 8 <= len(line.sent) - before <= 30  # polled about once a second
    assert device.snapshot.state is DeviceState.ONLINE
    assert line.engine.stats.opens == 1
    assert not line.engine.settings.same_wire(replace(new, baudrate=19200))
    assert not line.engine.settings.same_wire(replace(new, port="elsewhere"))


def test_other_queue_limits_hold_from_now_on(virtual_line: MakeLine) -> None:
    line = virtual_line(Registers(1), queue_limit=9)
    line.run(10.0)
    line.engine.adjust(replace(line.engine.settings, queue_limit=1), line.now)
    outcomes: list[Outcome] = []
    for address in (0x100, 0x200, 0x300):
        line.read(line.devices[0], registers(address, 2), outcomes.append)
    line.run(5.0)
    assert sum(isinstance(outcome, QueueFull) for outcome in outcomes) == 2


def test_after_a_suspend_or_497_days_there_is_one_round_of_polls_and_no_burst(virtual_line: MakeLine) -> None:
    line = virtual_line(Registers(1), Registers(2))
    line.run(30.0)
    before = len(line.sent)
    line.run(10.0)
    usual = len(line.sent) - before
    for slept_s in (3600.0, 2**32 / 100):
        line.now += slept_s  # nobody called: the machine slept, or the test does not want to wait
        before = len(line.sent)
        line.run(10.0)
        round_of_settings = 40
        assert usual - 5 <= len(line.sent) - before <= usual + round_of_settings
        assert [device.snapshot.state for device in line.devices] == [DeviceState.ONLINE] * 2
        assert all(line.now - at < 11.0 for device in line.devices for at in device.snapshot.read_at.values())
