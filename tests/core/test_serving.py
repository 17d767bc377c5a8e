"""What a device's memory answers, against a model of it that is a plain list of words."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.core.serving import CLIENT_BLOCKS, Ask, FromMemory, Serving, covered, read_reply
from gateway.core.site import Device
from gateway.core.snapshot import Block, DeviceState, Snapshot
from gateway.devices.model import Extent, PollClass, Space
from gateway.devices.schema import load_map
from gateway.errors import DeviceOffline, IllegalDataAddress, ReplyTimeout, RequestError
from gateway.modbus.pdu import ReadRequest

MAX_AGE_S = 5.0
NOW = 100.0


def block(first: int, count: int, read_at: float, *, tag: int = 0) -> Block:
    return Block(
        Space.REGISTERS, first, count, bytes((tag, at % 256)[i] for at in range(count) for i in (0, 1)), read_at
    )


def make(*blocks: Block, state: DeviceState = DeviceState.ONLINE, strict_map: bool = False) -> Serving:
    device = Device("array-1", 11, 1, load_map("prostar-mppt"))
    device.snapshot = Snapshot(state=state, blocks=blocks)
    return Serving(device, max_age_s=MAX_AGE_S, strict_map=strict_map)


def read(first: int, count: int, function: int = 3) -> bytes:
    return ReadRequest(function, first, count).encode()


def test_the_reply_says_until_when_it_is_right() -> None:
    serving = make(block(0, 16, NOW - 3))
    answer = serving.answer(read(4, 2), NOW)
    assert answer == FromMemory(b"\x03\x04\x00\x04\x00\x05", serving.device.snapshot.mark, NOW + 2)


@pytest.mark.parametrize(("age_s", "served"), [(0.0, True), (4.999, True), (5.0, False), (60.0, False)])
def test_age(age_s: float, served: bool) -> None:
    answer = make(block(0, 16, NOW - age_s)).answer(read(0, 1), NOW)
    assert isinstance(answer, FromMemory) is served


def test_of_several_blocks_the_youngest_answers() -> None:
    serving = make(block(0, 16, NOW - 2, tag=1), block(0, 8, NOW - 1, tag=2), block(0, 16, NOW - 3, tag=3))
    answer = serving.answer(read(0, 4), NOW)
    assert isinstance(answer, FromMemory)
    assert answer.reply[2] == 2
    answer = serving.answer(read(7, 2), NOW)
    assert isinstance(answer, FromMemory)
    assert answer.reply[2] == 1


@given(
    blocks=st.lists(st.tuples(st.integers(0, 40), st.integers(1, 40), st.floats(0, 10)), max_size=6),
    first=st.integers(0, 60),
    count=st.integers(1, 60),
)
def test_f39_a_reply_is_always_a_slice_of_one_young_block(
    blocks: list[tuple[int, int, float]], first: int, count: int
) -> None:
    held = [block(at, size, NOW - age, tag=tag) for tag, (at, size, age) in enumerate(blocks, 1)]
    answer = make(*held).answer(read(first, count), NOW)
    able = [b for b in held if b.first <= first and first + count <= b.first + b.count and NOW - b.read_at < MAX_AGE_S]
    if not able:
        assert isinstance(answer, Ask)
        return
    assert isinstance(answer, FromMemory)
    tags = set(answer.reply[2::2])
    assert len(tags) == 1
    source = held[tags.pop() - 1]
    assert source.read_at == max(b.read_at for b in able)
    assert answer.reply[3::2] == bytes((first - source.first + at) % 256 for at in range(count))


@given(data=st.binary(min_size=32, max_size=32), first=st.integers(0, 255), count=st.integers(1, 256))
def test_coils_are_cut_bit_by_bit(data: bytes, first: int, count: int) -> None:
    count = min(count, 256 - first)
    held = [data[at // 8] >> at % 8 & 1 for at in range(256)]
    reply = read_reply(Block(Space.COILS, 0, 256, data, 0.0), 1, first, count)
    assert reply[:2] == bytes((1, (count + 7) // 8))
    bits = [reply[2 + at // 8] >> at % 8 & 1 for at in range(8 * (len(reply) - 2))]
    assert bits == held[first : first + count] + [0] * (len(bits) - count)


def ask(serving: Serving, pdu: bytes, now: float = NOW) -> Ask:
    answer = serving.answer(pdu, now)
    assert isinstance(answer, Ask)
    return answer


def test_what_a_client_read_is_known_for_max_age_from_the_question() -> None:
    serving = make()
    serving.learn(ask(serving, read(0xE000, 3)), b"\x03\x06abcdef")
    answer = serving.answer(read(0xE001, 1), NOW + 4.9)
    assert answer == FromMemory(b"\x03\x02cd", serving.device.snapshot.mark, NOW + 5)
    ask(serving, read(0xE001, 1), NOW + 5)


def test_the_newest_read_of_a_range_wins_whatever_comes_first() -> None:
    serving = make()
    old, new = ask(serving, read(0xE000, 1), NOW), ask(serving, read(0xE000, 1), NOW + 1)
    serving.learn(new, b"\x03\x02NN")
    serving.learn(old, b"\x03\x02oo")
    answer = serving.answer(read(0xE000, 1), NOW + 2)
    assert isinstance(answer, FromMemory)
    assert answer.reply == b"\x03\x02NN"
    assert answer.valid_until == NOW + 1 + MAX_AGE_S


@pytest.mark.parametrize("outcome", [b"\x83\x02", b"\x03\x02a", b"\x03\x04abcd", ReplyTimeout()])
def test_only_whole_replies_are_learnt(outcome: bytes | RequestError) -> None:
    serving = make()
    serving.learn(ask(serving, read(0xE000, 1)), outcome)
    ask(serving, read(0xE000, 1))


def test_client_blocks_are_bounded_and_the_oldest_goes() -> None:
    serving = make()
    for at in range(CLIENT_BLOCKS + 1):
        serving.learn(ask(serving, read(at, 1)), b"\x03\x02aa")
    ask(serving, read(0, 1))
    for at in range(1, CLIENT_BLOCKS + 1):
        assert isinstance(serving.answer(read(at, 1), NOW), FromMemory)


def test_an_outage_ends_what_clients_had_read() -> None:
    serving = make()
    device = serving.device
    serving.learn(ask(serving, read(0xE000, 1)), b"\x03\x02aa")
    device.snapshot = replace(device.snapshot, state=DeviceState.STALE, state_since=NOW + 1)
    ask(serving, read(0xE000, 1), NOW + 1)
    device.snapshot = replace(device.snapshot, state=DeviceState.ONLINE, state_since=NOW + 2)
    ask(serving, read(0xE000, 1), NOW + 2)


def test_an_outage_nobody_asked_in_ends_it_too() -> None:
    serving = make()
    device = serving.device
    serving.learn(ask(serving, read(0xE000, 1)), b"\x03\x02aa")
    device.snapshot = replace(device.snapshot, state_since=NOW + 2)
    ask(serving, read(0xE000, 1), NOW + 2)


def test_a_quarantined_device_raises_at_once() -> None:
    class OpenLine:
        def status(self, now: float) -> object:
            from gateway.core.site import LineState, LineStatus

            return LineStatus(LineState.OPEN, 0.0, "", 0, 0.0)

    serving = make(block(0, 16, NOW), state=DeviceState.OFFLINE)
    serving.device.line = OpenLine()  # type: ignore[assignment]
    with pytest.raises(DeviceOffline):
        serving.answer(read(0, 1), NOW)


def test_strict_map_knows_every_extent_and_its_neighbours() -> None:
    serving = make(strict_map=True)
    for extent in serving.device.map.extents:
        if extent.space is Space.REGISTERS:
            ask(serving, read(extent.last, 1))
    with pytest.raises(IllegalDataAddress):
        serving.answer(read(0x7000, 1), NOW)
    ask(make(), read(0x7000, 1))


def test_extents_that_touch_are_one() -> None:
    def extent(first: int, last: int) -> Extent:
        return Extent("x", Space.REGISTERS, first, last, PollClass.LIVE, writable=False, doc="")

    extents = (extent(20, 29), extent(0, 9), extent(10, 14), extent(12, 13))
    assert covered(extents, Space.REGISTERS) == ((0, 15), (20, 30))
    assert covered(extents, Space.COILS) == ()


def test_identification_is_right_while_the_snapshot_lasts() -> None:
    from gateway.devices.model import Identification

    serving = make()
    assert ask(serving, b"\x2b\x0e\x01\x00").read is None
    serving.device.snapshot = replace(serving.device.snapshot, identification=Identification("a", "b", "c"))
    answer = serving.answer(b"\x2b\x0e\x01\x00", NOW)
    assert isinstance(answer, FromMemory)
    assert answer.valid_until == math.inf
