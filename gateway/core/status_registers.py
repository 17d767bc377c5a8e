"""Unit 255: what the gateway tells a Modbus client of itself: its lines, its controllers, and how old their values are.

Rule 1: `COLUMNS` is the only place where a register is described; the answers and docs/registers/gateway.md come from
        it. `LAYOUT` grows when a register is changed or taken away, not when one is added.
Rule 2: a column has a row for each line (by its place in the configuration, from 1) or controller (by its unit id).
        Rows of nobody are 0. What lies between the columns is exception 02.
Rule 3: a number of 32 bits is high word first and whole; a counter starts again from 0 after 4294967295.
Rule 4: there is always an answer, whatever lines and controllers do: nothing here waits.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum
from types import MappingProxyType

from gateway.core.identification import identify
from gateway.core.policy import READ_DEVICE_IDENTIFICATION
from gateway.core.site import Device, LinePort, LineState, LineStatus, Site
from gateway.core.snapshot import DeviceState
from gateway.core.stats import ModbusServerStats
from gateway.devices.model import Identification
from gateway.errors import IllegalDataAddress
from gateway.modbus.pdu import Function, parse_read

UNIT = 255
"""The unit id that stands for the server itself (Messaging on TCP/IP V1.0b, 4.4.1.2)."""

LAYOUT = 1
FUNCTIONS = frozenset({int(Function.READ_HOLDING_REGISTERS), int(Function.READ_INPUT_REGISTERS)})
NEVER = 0xFFFF
OLDEST = 0xFFFE
MOST_LINES = 127
MOST_UNIT = 247

DEVICE_STATES: Mapping[DeviceState, int] = MappingProxyType(
    {DeviceState.UNKNOWN: 1, DeviceState.ONLINE: 2, DeviceState.STALE: 3, DeviceState.OFFLINE: 4}
)
LINE_STATES: Mapping[LineState, int] = MappingProxyType({LineState.DOWN: 1, LineState.OPEN: 2})


@dataclass(frozen=True, slots=True)
class Moment:
    """Where all values of one reply come from."""

    site: Site
    stats: ModbusServerStats
    uptime_s: float
    now: float


class Of(Enum):
    """What the rows of a column stand for."""

    GATEWAY = range(1)
    LINE = range(MOST_LINES + 1)
    DEVICE = range(MOST_UNIT + 1)


@dataclass(frozen=True, slots=True)
class Column:
    """Registers of one meaning, one after the other: row n begins at `first + words × n`."""

    first: int
    words: int
    of: Of
    name: str
    help: str
    value: Callable[[Moment, int], int]  # of a row; cut to the words

    @property
    def end(self) -> int:
        """One past the last register."""
        return self.first + self.words * len(self.of.value)


def _line(first: int, words: int, name: str, help_: str, value: Callable[[LinePort, LineStatus], int]) -> Column:
    def of_row(moment: Moment, row: int) -> int:
        if not 1 <= row <= len(moment.site.lines):
            return 0
        line = moment.site.lines[row - 1]
        return value(line, line.status(moment.now))

    return Column(first, words, Of.LINE, name, help_, of_row)


def _device(first: int, words: int, name: str, help_: str, value: Callable[[Device, float], int]) -> Column:
    def of_row(moment: Moment, row: int) -> int:
        device = moment.site.by_unit.get(row)
        return 0 if device is None else value(device, moment.now)

    return Column(first, words, Of.DEVICE, name, help_, of_row)


def _gateway(first: int, words: int, name: str, help_: str, value: Callable[[Moment], int]) -> Column:
    return Column(first, words, Of.GATEWAY, name, help_, lambda moment, _row: value(moment))


def _states(state: DeviceState) -> Callable[[Moment], int]:
    return lambda moment: sum(device.snapshot.state is state for device in moment.site.devices)


def _age_ds(at: float | None, now: float) -> int:
    return NEVER if at is None else min(OLDEST, max(0, int(10 * (now - at))))


def _refresh_ds(device: Device) -> int:
    refresh_s = device.stats.refresh_s
    return NEVER if refresh_s is None else min(OLDEST, int(10 * refresh_s))


COLUMNS: tuple[Column, ...] = (
    _gateway(0x0000, 1, "layout", f"Number of this table: {LAYOUT}.", lambda _: LAYOUT),
    _gateway(0x0001, 1, "lines", "Lines in the configuration.", lambda moment: len(moment.site.lines)),
    _gateway(0x0002, 1, "devices", "Controllers in the configuration.", lambda moment: len(moment.site.devices)),
    _gateway(0x0003, 1, "devices_online", "Controllers that are online.", _states(DeviceState.ONLINE)),
    _gateway(0x0004, 1, "devices_offline", "Controllers that are offline.", _states(DeviceState.OFFLINE)),
    _gateway(
        0x0005,
        1,
        "lines_open",
        "Lines whose port is open.",
        lambda moment: sum(line.status(moment.now).state is LineState.OPEN for line in moment.site.lines),
    ),
    _gateway(0x0006, 2, "uptime", "Seconds since the start.", lambda moment: int(moment.uptime_s)),
    _gateway(0x0008, 1, "connections", "Open Modbus TCP connections.", lambda moment: moment.stats.open_connections),
    _gateway(0x0009, 2, "requests", "Modbus TCP requests since the start.", lambda moment: moment.stats.requests),
    _gateway(0x000B, 2, "cache_hits", "Of these, answered from memory.", lambda moment: moment.stats.cache_hits),
    _gateway(0x000D, 2, "forwarded", "Of these, answered by a line.", lambda moment: moment.stats.forwarded),
    _device(
        0x0100,
        1,
        "device_state",
        "1 unknown (no reply since the start), 2 online, 3 stale, 4 offline.",
        lambda device, _: DEVICE_STATES[device.snapshot.state],
    ),
    _device(
        0x0200,
        1,
        "device_age",
        f"Tenths of a second since its last reply; {OLDEST}: that or more, {NEVER}: never.",
        lambda device, now: _age_ds(device.snapshot.last_reply_at, now),
    ),
    _device(
        0x0300,
        1,
        "device_refresh",
        f"Tenths of a second between two readings of its live values; {NEVER}: not known yet.",
        lambda device, _: _refresh_ds(device),
    ),
    _device(0x0400, 1, "device_line", "The line that it is on.", lambda device, _: device.line.index),
    _device(0x0500, 2, "device_polls", "Polls since the start.", lambda device, _: device.stats.polls),
    _device(
        0x0700,
        2,
        "device_failures",
        "Requests without a usable reply, or refused, since the start.",
        lambda device, _: device.stats.failures,
    ),
    _line(0x0900, 1, "line_state", "1 down, 2 open.", lambda _, status: LINE_STATES[status.state]),
    _line(
        0x0980, 1, "line_use", "Use in the last minute, in permille.", lambda _, status: round(1000 * status.use_ratio)
    ),
    _line(0x0A00, 1, "line_queue", "Requests of clients that wait for it.", lambda _, status: status.queue_depth),
    _line(0x0B00, 2, "line_requests", "Requests sent since the start.", lambda line, _: line.stats.sent),
    _line(
        0x0C00,
        2,
        "line_failures",
        "Of these, without a usable reply, or answered by an exception.",
        lambda line, _: line.stats.failed.total(),
    ),
)
"""Every register, by ascending address."""

_FIRSTS = [column.first for column in COLUMNS]


class StatusRegisters:
    """Answers for unit 255."""

    def __init__(self, site: Site, stats: ModbusServerStats, *, started_at: float, version: str) -> None:
        """`started_at`: monotonic seconds."""
        self._site = site
        self._stats = stats
        self._started_at = started_at
        self._identification = Identification("prostar-gateway", "prostar-gateway", version)

    def answer(self, pdu: bytes, now: float) -> bytes:
        """The reply to a read that the policy allows; raises the RequestError that refuses it."""
        if pdu[0] == READ_DEVICE_IDENTIFICATION:
            reply = identify(pdu, self._identification)
            assert reply is not None, "it is known"
            return reply
        read = parse_read(pdu)
        moment = Moment(self._site, self._stats, now - self._started_at, now)
        known: dict[tuple[int, int], int] = {}
        words = [_word(address, moment, known) for address in range(read.address, read.address + read.count)]
        return bytes((read.function, 2 * read.count)) + b"".join(word.to_bytes(2) for word in words)


def _word(address: int, moment: Moment, known: dict[tuple[int, int], int]) -> int:
    """One register; `known` are the values of this reply by column and row."""
    column = COLUMNS[bisect_right(_FIRSTS, address) - 1]
    if address >= column.end:
        raise IllegalDataAddress
    row, word = divmod(address - column.first, column.words)
    key = (column.first, row)
    if key not in known:
        known[key] = column.value(moment, row) % (1 << 16 * column.words)
    return known[key] >> 16 * (column.words - 1 - word) & 0xFFFF
