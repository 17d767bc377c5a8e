from __future__ import annotations

import struct
from collections.abc import Callable, Mapping

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.history.harvest import BlockRead, Harvest, Outcome
from gateway.history.identity import Position
from tests.history.blocks import EMPTY, HI_LO, LAYOUT, MAP, block, full_ring

HOURS = [1000 + 24 * day for day in range(256)]
LIVE = HOURS[-1] + 5


class Controller:
    """Answers reads from a ring; `refuses` says which reads it takes no exception to answering with 02."""

    def __init__(self, blocks: Mapping[int, bytes], refuses: Callable[[BlockRead], bool] = lambda _read: False) -> None:
        self.blocks = blocks
        self.refuses = refuses
        self.reads: list[BlockRead] = []

    def answer(self, read: BlockRead) -> bytes:
        self.reads.append(read)
        assert 0 <= read.first <= read.first + read.count <= 256
        pdu = read.pdu(MAP, LAYOUT)
        assert pdu == struct.pack(">BHH", 3, 0x8000 + 16 * read.first, 16 * read.count)
        if self.refuses(read):
            return b"\x83\x02"
        data = b"".join(self.blocks[slot] for slot in range(read.first, read.first + read.count))
        return bytes((3, len(data))) + data

    def harvest(self, harvest: Harvest) -> Harvest:
        while (read := harvest.next_read()) is not None:
            harvest.replied(read, self.answer(read), 0.0)
        return harvest


def position(slot: int, ring: Mapping[int, bytes], hourmeter: int) -> Position:
    return Position(slot, hourmeter, ring[slot], HI_LO)


def test_a_whole_ring_takes_37_reads_of_seven_blocks() -> None:
    controller = Controller(full_ring(HOURS))
    harvest = controller.harvest(Harvest(LAYOUT, LIVE))
    assert harvest.outcome is Outcome.WHOLE
    assert harvest.blocks == controller.blocks
    assert [read.count for read in controller.reads] == [7] * 36 + [4]


@pytest.mark.parametrize("slot", [0, 10, 252, 255])
@pytest.mark.parametrize("new", [0, 1, 5, 6, 7, 20])
def test_only_what_follows_the_known_day_is_read(slot: int, new: int) -> None:
    ring = full_ring(HOURS, first=slot + 1)
    known = position(slot, ring, HOURS[-1])
    added = {(slot + 1 + n) % 256: block(HOURS[-1] + 24 * (n + 1)) for n in range(new)}
    controller = Controller({**ring, **added})
    harvest = controller.harvest(Harvest(LAYOUT, LIVE + 24 * new, known))
    assert harvest.outcome is Outcome.NEWER
    assert harvest.blocks == added
    assert sum(read.count for read in controller.reads) <= new + 14


def test_a_cleared_block_ends_what_is_new() -> None:
    ring = full_ring(HOURS[:10]) | {10: EMPTY}
    harvest = Controller(ring).harvest(Harvest(LAYOUT, LIVE, position(8, ring, HOURS[8])))
    assert harvest.blocks == {9: ring[9]}
    assert not harvest.odd


def test_an_hourmeter_that_cannot_be_ends_it_and_is_told() -> None:
    ring = full_ring(HOURS[:10]) | {10: block(99_999)}
    harvest = Controller(ring).harvest(Harvest(LAYOUT, HOURS[9] + 5, position(9, ring, HOURS[9])))
    assert (harvest.outcome, harvest.blocks, harvest.odd) == (Outcome.NEWER, {}, True)


def test_a_tie_does_not_hide_the_days_behind_it() -> None:
    ring = full_ring(HOURS[:10]) | {10: block(HOURS[9], low_v=11), 11: block(HOURS[10])}
    harvest = Controller(ring).harvest(Harvest(LAYOUT, HOURS[10], position(9, ring, HOURS[9])))
    assert harvest.blocks == {10: ring[10], 11: ring[11]}


def test_when_the_known_day_is_not_there_the_whole_ring_is_read() -> None:
    ring = full_ring(HOURS)
    controller = Controller(ring)
    harvest = controller.harvest(Harvest(LAYOUT, LIVE, Position(255, HOURS[-1], block(1), HI_LO)))
    assert (harvest.outcome, harvest.blocks) == (Outcome.WHOLE, ring)
    assert len(controller.reads) == 38


def test_staged_blocks_are_not_read_again_but_for_one() -> None:
    ring = full_ring(HOURS)
    controller = Controller(ring)
    staged = {slot: ring[slot] for slot in range(70)}
    harvest = controller.harvest(Harvest(LAYOUT, LIVE, staged=staged))
    assert (harvest.outcome, harvest.blocks) == (Outcome.WHOLE, ring)
    assert controller.reads[0] == BlockRead(69, 1)
    assert sum(read.count for read in controller.reads) == 1 + 186
    assert not harvest.stage_anew


def test_staged_blocks_of_another_controller_are_dropped() -> None:
    ring = full_ring(HOURS)
    other = full_ring(HOURS, volts=11.0)
    harvest = Controller(ring).harvest(Harvest(LAYOUT, LIVE, staged={slot: other[slot] for slot in range(70)}))
    assert harvest.blocks == ring
    assert harvest.stage_anew


@pytest.mark.parametrize(("takes", "most"), [(3, 3), (2, 1), (1, 1), (6, 3), (7, 7)])
def test_a_controller_that_takes_fewer_blocks_a_read_is_asked_for_fewer(takes: int, most: int) -> None:
    controller = Controller(full_ring(HOURS), lambda read: read.count > takes)
    harvest = controller.harvest(Harvest(LAYOUT, LIVE))
    assert (harvest.outcome, harvest.blocks, harvest.most) == (Outcome.WHOLE, controller.blocks, most)


def test_a_block_that_is_refused_does_not_hold_up_the_others() -> None:
    bad = {0, 100, 255}
    ring = full_ring(HOURS)
    controller = Controller(ring, lambda read: bool(bad & set(range(read.first, read.first + read.count))))
    harvest = controller.harvest(Harvest(LAYOUT, LIVE))
    assert (harvest.outcome, harvest.unread) == (Outcome.WHOLE, bad)
    assert harvest.blocks == {slot: words for slot, words in ring.items() if slot not in bad}


def test_a_controller_without_a_log_is_left_alone_soon() -> None:
    controller = Controller({}, lambda _read: True)
    harvest = controller.harvest(Harvest(LAYOUT, LIVE))
    assert harvest.outcome is Outcome.FAILED
    assert len(controller.reads) <= 6


def test_a_read_that_fails_is_made_again_after_a_pause_in_smaller_pieces() -> None:
    harvest = Harvest(LAYOUT, LIVE)
    now, seen = 0.0, []
    for _ in range(7):
        read = harvest.next_read()
        assert read is not None
        seen.append((read.first, read.count))
        harvest.failed(now)
        assert harvest.ready_at > now
        now = harvest.ready_at
    assert seen == [(0, 7), (0, 7), (0, 3), (0, 3), (0, 1), (0, 1), (0, 1)]
    assert harvest.unread == {0}
    assert harvest.next_read() == BlockRead(1, 7)
    assert now < 300


def test_the_known_day_that_cannot_be_read_fails_the_harvest() -> None:
    ring = full_ring(HOURS)
    controller = Controller(ring, lambda _read: True)
    assert controller.harvest(Harvest(LAYOUT, LIVE, position(3, ring, 1072))).outcome is Outcome.FAILED


@given(st.binary(max_size=300))
def test_any_reply_is_taken_whole_or_not_at_all(reply: bytes) -> None:
    harvest = Harvest(LAYOUT, LIVE)
    read = harvest.next_read()
    assert read is not None
    got = harvest.replied(read, b"\x03" + reply, 0.0)
    if len(reply) == 1 + 7 * 32:
        assert b"".join(got.values()) == reply[1:]
    else:
        assert got == harvest.blocks == {}


@given(st.data())
def test_any_mix_of_failures_and_refusals_comes_to_an_end_with_nothing_half(data: st.DataObject) -> None:
    ring = full_ring(HOURS)
    controller = Controller(ring)
    harvest = Harvest(LAYOUT, LIVE)
    now = 0.0
    for _ in range(3000):
        read = harvest.next_read()
        if read is None:
            break
        now = max(now, harvest.ready_at)
        luck = data.draw(st.sampled_from("rrrrrrrfxs")) if len(controller.reads) < 150 else "r"
        reply = controller.answer(read)
        if luck == "r":
            harvest.replied(read, reply, now)
        elif luck == "f":
            harvest.failed(now)
        elif luck == "x":
            harvest.replied(read, b"\x83\x02", now)
        else:
            harvest.replied(read, reply[:-1], now)
    assert harvest.outcome is not None
    assert all(ring[slot] == words for slot, words in harvest.blocks.items())
    if harvest.outcome is Outcome.WHOLE:
        assert harvest.blocks.keys() | harvest.unread == set(range(256))


def test_staged_blocks_that_cannot_be_proved_are_dropped() -> None:
    ring = full_ring(HOURS)
    controller = Controller(ring, lambda read: read.first <= 69 < read.first + read.count)
    harvest = controller.harvest(Harvest(LAYOUT, LIVE, staged={slot: ring[slot] for slot in range(70)}))
    assert (harvest.outcome, harvest.unread, harvest.stage_anew) == (Outcome.WHOLE, {69}, True)


def test_a_controller_that_is_busy_is_asked_again() -> None:
    harvest = Harvest(LAYOUT, LIVE)
    read = harvest.next_read()
    assert read is not None
    assert harvest.replied(read, b"\x83\x06", 10.0) == {}
    assert harvest.ready_at > 10.0
    assert harvest.next_read() == read


def test_a_ring_in_which_everything_is_new_ends_after_one_turn() -> None:
    ring = full_ring(HOURS, first=1)
    known = Position(0, HOURS[0] - 24, ring[0], HI_LO)
    harvest = Controller(ring).harvest(Harvest(LAYOUT, LIVE, known))
    assert (harvest.outcome, len(harvest.blocks)) == (Outcome.NEWER, 255)
