"""The table of unit 255: every register where the table says, whole numbers, nothing between the columns."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.core.site import Device, LineState, LineStatus, Outcome, Site
from gateway.core.snapshot import DeviceState
from gateway.core.stats import LineStats, ModbusServerStats
from gateway.core.status_registers import COLUMNS, NEVER, OLDEST, Of, StatusRegisters
from gateway.devices.schema import load_map
from gateway.errors import IllegalDataAddress
from gateway.modbus.pdu import ReadRequest, parse_identification

MAP = load_map("prostar-mppt")
STARTED_AT = 500.0
NOW = 100_000.0
AT = {column.name: column.first for column in COLUMNS}


@dataclass(eq=False)
class Line:
    """A line that cannot be asked."""

    name: str
    index: int
    state: LineState = LineState.OPEN
    use_ratio: float = 0.0
    queue_depth: int = 0
    port: str = ""
    stats: LineStats = field(default_factory=LineStats)

    def status(self, now: float) -> LineStatus:
        return LineStatus(self.state, now, "", self.queue_depth, self.use_ratio)

    def read(self, *_: object, **__: object) -> Outcome:
        raise AssertionError("nothing waits for a line")

    write = read


class World:
    """Two lines and three controllers: online, offline, never heard."""

    def __init__(self) -> None:
        self.lines = Line("a", 1, use_ratio=0.9876, queue_depth=3), Line("b", 2, LineState.DOWN)
        self.lines[0].stats.sent = 70_000
        self.lines[0].stats.failed.update(timeout=2, crc=1)
        self.devices = [Device(f"array-{unit}", unit, 1, MAP) for unit in (1, 11, 247)]
        for device, line in zip(self.devices, (*self.lines, self.lines[1]), strict=True):
            device.line = line  # type: ignore[assignment]  # its reads fail on purpose
        one, two, _ = self.devices
        one.snapshot = replace(one.snapshot, state=DeviceState.ONLINE, last_reply_at=NOW - 1.25)
        one.stats.refresh_s, one.stats.polls, one.stats.failures = 1.06, 65_537, 4
        two.snapshot = replace(two.snapshot, state=DeviceState.OFFLINE, last_reply_at=NOW - 7000)
        self.stats = ModbusServerStats(open_connections=5, requests=(1 << 32) + 70_001, cache_hits=69_000, forwarded=7)
        site = Site.of("ridge-07", self.lines, self.devices)  # type: ignore[arg-type]  # as above
        self.registers = StatusRegisters(site, self.stats, started_at=STARTED_AT, version="1.2.3")

    def words(self, first: int, count: int = 1, function: int = 3) -> list[int]:
        reply = self.registers.answer(ReadRequest(function, first, count).encode(), NOW)
        assert reply[:2] == bytes((function, 2 * count))
        return [int.from_bytes(reply[at : at + 2]) for at in range(2, len(reply), 2)]


@pytest.fixture
def world() -> World:
    return World()


def test_columns_do_not_overlap_and_have_names_of_their_own() -> None:
    ends = 0
    for column in COLUMNS:
        assert column.first >= ends
        assert column.help.endswith(".")
        ends = column.end
    assert ends <= 0x10000
    assert len(AT) == len(COLUMNS)


@pytest.mark.parametrize("function", [3, 4])
def test_the_gateway(world: World, function: int) -> None:
    assert world.words(0, 15, function) == [
        *(1, 2, 3, 1, 1, 1),  # layout, lines, devices, online, offline, lines that are open
        *(99_500 >> 16, 99_500 & 0xFFFF),
        5,
        *(70_001 >> 16, 70_001 & 0xFFFF),  # it began again from 0
        *(69_000 >> 16, 69_000 & 0xFFFF),
        *(0, 7),
    ]


@pytest.mark.parametrize(
    ("name", "of_one", "of_eleven", "of_the_last"),
    [
        ("device_state", 2, 4, 1),
        ("device_age", 12, OLDEST, NEVER),
        ("device_refresh", 10, NEVER, NEVER),
        ("device_line", 1, 2, 2),
    ],
)
def test_a_register_a_controller(world: World, name: str, of_one: int, of_eleven: int, of_the_last: int) -> None:
    first = AT[name]
    assert world.words(first, 12) == [0, of_one, *([0] * 9), of_eleven]
    assert world.words(first + 246, 2) == [0, of_the_last]


def test_two_registers_a_controller(world: World) -> None:
    assert world.words(AT["device_polls"] + 2, 4) == [1, 1, 0, 0]
    assert world.words(AT["device_polls"] + 3) == [1], "half of it, for who asks so"
    assert world.words(AT["device_failures"] + 2, 2) == [0, 4]


def test_lines(world: World) -> None:
    assert world.words(AT["line_state"], 4) == [0, 2, 1, 0]
    assert world.words(AT["line_use"] + 1) == [988]
    assert world.words(AT["line_queue"] + 1) == [3]
    assert world.words(AT["line_requests"] + 2, 4) == [1, 70_000 - 65_536, 0, 0]
    assert world.words(AT["line_failures"] + 2, 2) == [0, 3]


@given(first=st.integers(0, 0xFFFF), count=st.integers(1, 125))
def test_a_read_is_answered_when_all_of_it_is_there(first: int, count: int) -> None:
    there = {address for column in COLUMNS for address in range(column.first, column.end)}
    count = min(count, 0x10000 - first)
    if set(range(first, first + count)) <= there:
        assert len(World().words(first, count)) == count
    else:
        with pytest.raises(IllegalDataAddress):
            World().words(first, count)


def test_rows_of_nobody_are_0(world: World) -> None:
    for column in COLUMNS:
        if column.of is not Of.GATEWAY:
            assert world.words(column.first, column.words) == [0] * column.words
            assert world.words(column.end - column.words, column.words)[0] in {0, *(DEVICE_OF_247.get(column.name, ()))}


DEVICE_OF_247 = {"device_state": (1,), "device_age": (NEVER,), "device_refresh": (NEVER,), "device_line": (2,)}


def test_it_says_who_it_is(world: World) -> None:
    reply = world.registers.answer(bytes.fromhex("2b 0e 01 00"), NOW)
    assert parse_identification(reply).objects == {0: b"prostar-gateway", 1: b"prostar-gateway", 2: b"1.2.3"}
