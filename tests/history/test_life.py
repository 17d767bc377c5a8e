"""Whatever happens to a gateway in months, in any order: in the end every day is there, once, as it was."""

from __future__ import annotations

import asyncio
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gateway.devices.log import decode_log, split_blocks
from gateway.devices.model import Space, WordOrder
from gateway.history import database
from gateway.history.database import FILE_NAME
from gateway.simulator.device import SimulatedController
from tests.history.blocks import LAYOUT, MAP
from tests.history.virtual_site import VirtualClock, VirtualGateway, VirtualPort

DAY_S = 86_400.0
YOUNG = 2
"""Seed of a unit of 37 days: its ring overwrites nothing within the life of a test."""

Event = tuple[str, float]
events = st.lists(
    st.one_of(
        st.tuples(st.just("runs for"), st.floats(0.1, 30.0)),
        st.tuples(st.just("is restarted after"), st.sampled_from([0.0, 3600.0, DAY_S, 5.2 * DAY_S, 30.5 * DAY_S])),
        st.tuples(st.just("has no line for"), st.sampled_from([5.0, 7200.0, 2.1 * DAY_S])),
        st.tuples(st.just("hears noise, replies"), st.integers(1, 20).map(float)),
        st.tuples(st.just("has its clock set by"), st.sampled_from([-400 * DAY_S, -90.0, 3600.0, 5 * DAY_S])),
        st.tuples(st.just("cannot write for"), st.floats(1.0, 100.0)),
    ),
    max_size=12,
)


def days_of(controller: SimulatedController) -> dict[int, bytes]:
    words = controller.memory.read(Space.REGISTERS, LAYOUT.first, LAYOUT.blocks * LAYOUT.block_words)
    ring = split_blocks(LAYOUT, b"".join(word.to_bytes(2, "big") for word in words))
    return {day.hourmeter: ring[day.slot] for day in decode_log(LAYOUT, ring).days}


def stored(directory: Path) -> dict[int, bytes]:
    with closing(sqlite3.connect(directory / FILE_NAME)) as connection:
        if not connection.execute("SELECT 1 FROM sqlite_schema WHERE name = 'day'").fetchall():
            return {}  # locked before it was made
        assert connection.execute("SELECT count(*) FROM controller").fetchone() <= (1,)
        assert connection.execute("SELECT count(*) FROM apart").fetchone() == (0,)
        return dict(connection.execute("SELECT hourmeter, words FROM day").fetchall())


class Life:
    """A controller and the gateways that come and go."""

    def __init__(self, directory: Path, order: WordOrder) -> None:
        self.directory = directory
        self.clock = VirtualClock()
        self.controller = SimulatedController(MAP, seed=YOUNG, step_s=300.0, log_order=order)
        self.gateway = self._new_gateway()

    def _new_gateway(self) -> VirtualGateway:
        return VirtualGateway(self.directory, self.clock, VirtualPort(self.clock, [self.controller], 5.0))

    async def live(self, life: list[Event]) -> None:
        await self.gateway.__aenter__()
        try:
            for what, amount in life:
                await self._happen(what, amount)
                truth = days_of(self.controller)
                if (self.directory / FILE_NAME).exists():
                    assert stored(self.directory).items() <= truth.items()
            self.controller.advance(self.clock.now)
            truth = days_of(self.controller)
            await self.gateway.until(lambda: self.gateway.stats.devices[11].days == len(truth), seconds=2 * DAY_S)
        finally:
            await self.gateway.__aexit__()
        assert stored(self.directory) == truth

    async def _happen(self, what: str, amount: float) -> None:
        gateway, clock = self.gateway, self.clock
        if what == "runs for":
            await gateway.run(amount)
        elif what == "is restarted after":
            await gateway.__aexit__()
            clock.now += amount
            self.gateway = self._new_gateway()
            await self.gateway.__aenter__()
        elif what == "has no line for":
            gateway.port.engine.closed("unplugged", clock.now)
            await gateway.run(1.0)
            clock.now += amount
            gateway.port.wire.clear()
            gateway.port.engine.opened(clock.now)
        elif what == "hears noise, replies":
            gateway.port.wire.corrupt_replies(int(amount))
            await gateway.run(amount)
        elif what == "has its clock set by":
            clock.wall_offset += amount
            await gateway.run(3.0)
        else:
            with closing(sqlite3.connect(self.directory / FILE_NAME, isolation_level=None)) as other:
                other.execute("PRAGMA busy_timeout = 0")
                try:
                    other.execute("BEGIN EXCLUSIVE")
                except sqlite3.OperationalError:
                    return  # it is being written at this moment
                await gateway.run(amount)


@pytest.fixture(scope="module")
def no_waiting_for_locks() -> Iterator[None]:
    """SQLite waits for a lock in real time, of which virtual time has none."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(database, "BUSY_S", 0.0)
        yield


def live(life: list[Event], order: WordOrder) -> None:
    with TemporaryDirectory() as folder:
        asyncio.run(Life(Path(folder), order).live(life))


@settings(max_examples=15)
@given(life=events, order=st.sampled_from(WordOrder))
def test_no_day_is_lost_and_none_is_there_twice(
    no_waiting_for_locks: None, life: list[Event], order: WordOrder
) -> None:
    live(life, order)


@pytest.mark.long
@settings(max_examples=300)
@given(life=events, order=st.sampled_from(WordOrder))
def test_no_day_is_lost_in_many_lives(no_waiting_for_locks: None, life: list[Event], order: WordOrder) -> None:
    live(life, order)
