"""The chaos medium: what each fault does to a frame, that a seed repeats itself, and what it never makes up."""

from __future__ import annotations

from collections.abc import Sequence

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.devices.schema import load_map
from gateway.modbus.crc import append_crc, crc_ok
from gateway.modbus.frames import Exchange
from gateway.simulator.chaos import PORT_FAULTS, STRANGERS, Chaos, Fault, all_at
from gateway.simulator.line import SimulatedLine
from gateway.simulator.medium import Burst
from gateway.simulator.oracle import OracleController

REQUEST = append_crc(bytes.fromhex("01 03 0010 0004"))
REPLY = append_crc(bytes.fromhex("01 03 08 1111 2222 3333 4444"))


def exchange(chaos: Chaos, at: float = 100.0) -> tuple[Sequence[Burst], bytes, Sequence[Burst]]:
    return chaos.echo(REQUEST, at), chaos.request(REQUEST, at + 0.01), chaos.reply(REPLY, at + 0.02)


def joined(bursts: Sequence[Burst]) -> bytes:
    return b"".join(burst.data for burst in bursts)


def forced(*faults: Fault, for_s: float | None = None, in_request: bool = False, seed: int = 1) -> Chaos:
    chaos = Chaos(seed)
    chaos.force(*faults, for_s=for_s, in_request=in_request)
    return chaos


def test_without_faults_it_changes_nothing() -> None:
    assert exchange(Chaos(1)) == ((), REQUEST, [Burst(100.02, REPLY)])


def test_a_forced_fault_hits_one_request_and_is_counted() -> None:
    chaos = forced(Fault.TRUNCATE)
    short = joined(exchange(chaos)[2])
    assert REPLY.startswith(short)
    assert len(short) < len(REPLY)
    assert exchange(chaos)[2] == [Burst(100.02, REPLY)]
    assert chaos.counts == {Fault.TRUNCATE: 1}


def test_each_fault_does_what_it_says() -> None:
    echo, _, _ = exchange(forced(Fault.ECHO))
    assert echo == (Burst(100.0, REQUEST),)
    assert exchange(forced(Fault.DROP, in_request=True))[1] == b""
    assert exchange(forced(Fault.DROP))[1:] == (REQUEST, ())
    assert not crc_ok(exchange(forced(Fault.BIT_FLIP, in_request=True))[1])
    assert not crc_ok(joined(exchange(forced(Fault.BIT_FLIP))[2]))
    assert joined(exchange(forced(Fault.DUPLICATE))[2]) == REPLY + REPLY
    assert exchange(forced(Fault.JOIN))[2] == [Burst(100.02, REPLY, whole=True)]
    assert exchange(forced(Fault.DELAY, for_s=0.2))[2][0].at == pytest.approx(100.22)
    before = joined(exchange(forced(Fault.NOISE_BEFORE))[2])
    assert before.endswith(REPLY)
    assert 1 <= len(before) - len(REPLY) <= 300
    after = exchange(forced(Fault.NOISE_AFTER))[2]
    assert after[0].data == REPLY
    assert len(after) == 2
    stranger = joined(exchange(forced(Fault.WRONG_UNIT))[2])[: len(REPLY)]
    assert crc_ok(stranger)
    assert stranger[0] in STRANGERS
    pieces = exchange(forced(Fault.SPLIT, seed=3))[2]
    assert joined(pieces) == REPLY
    assert len(pieces) > 1


@pytest.mark.parametrize("fault", [Fault.WRONG_FUNCTION, Fault.WRONG_COUNT])
def test_a_made_up_frame_has_a_right_crc_and_does_not_fit(fault: Fault) -> None:
    for seed in range(20):
        frame = joined(exchange(forced(fault, seed=seed))[2])
        assert crc_ok(frame)
        assert frame[0] == 1
        exchange_ = Exchange.of(1, REQUEST[1:-2])
        assert exchange_.find(bytearray(frame), 0, 0) is None


def test_a_silent_device_hears_nothing_until_its_time_is_over() -> None:
    chaos = forced(Fault.SILENCE, for_s=2.0)
    assert [exchange(chaos, at)[1] for at in (100.0, 101.0, 101.99)] == [b""] * 3
    assert exchange(chaos, 102.1)[1] == REQUEST


def test_a_late_reply_holds_back_the_next_of_its_device_and_no_others() -> None:
    chaos = forced(Fault.LATE, for_s=3.0)
    assert exchange(chaos)[2][0].at == pytest.approx(103.02)
    assert exchange(chaos, 101.0)[2][0].at == pytest.approx(103.02)
    assert chaos.reply(b"\x02" + REPLY[1:], 101.5)[0].at == 101.5


def test_the_owner_of_the_port_is_told() -> None:
    told: list[Fault] = []
    chaos = Chaos(1, dict.fromkeys(PORT_FAULTS, 1.0), on_port_fault=told.append)
    exchange(chaos)
    assert told == [Fault.CLOSE, Fault.UNPLUG]


def test_a_seed_repeats_itself_and_another_does_not() -> None:
    def run(seed: int) -> list[object]:
        chaos = Chaos(seed, all_at(0.2))
        return [exchange(chaos, float(at)) for at in range(200)]

    assert run(7) == run(7)
    assert run(7) != run(8)


def test_every_kind_comes_at_its_rate() -> None:
    chaos = Chaos(5, all_at(0.05, but=frozenset()), on_port_fault=lambda _: None)
    for at in range(20_000):
        exchange(chaos, 10.0 * at)
    assert set(chaos.counts) == set(Fault)
    for fault, count in chaos.counts.items():
        halved = fault in {Fault.DROP, Fault.BIT_FLIP}  # the other half may be hidden by another fault
        assert 0.5 * 1000 < count < (1.1 if halved else 1.5) * 1000, fault


def test_an_error_carries_the_seed_and_the_wire() -> None:
    def fail() -> None:
        with chaos:
            exchange(chaos)
            raise AssertionError("a wrong value")

    chaos = Chaos(4711, log_size=4)
    for at in range(50):
        exchange(chaos, float(at))
    with pytest.raises(AssertionError) as caught:
        fail()
    (note,) = caught.value.__notes__
    assert "seed=4711" in note
    assert REPLY.hex(" ") in note
    assert len(note.splitlines()) == 5


@given(seed=st.integers(0, 2**32), rate=st.floats(0.0, 1.0))
def test_nothing_is_made_up_that_could_be_taken_for_the_answer(seed: int, rate: float) -> None:
    """Whatever the faults: a frame that fits the request is the reply itself."""
    unit = OracleController(load_map("prostar-mppt"))
    line = SimulatedLine([unit], medium=Chaos(seed, all_at(rate)))
    wanted = Exchange.of(1, REQUEST[1:-2])
    now, heard = 0.0, bytearray()
    for _ in range(10):
        line.receive(REQUEST, now)
        now += 6.0
        heard += line.take(now)
    right = append_crc(b"\x01" + (unit.handle(REQUEST[1:-2], now) or b""))
    at = 0
    while (found := wanted.find(heard, at, 0)) is not None:
        assert heard[found.start : found.end] == right
        at = found.end
