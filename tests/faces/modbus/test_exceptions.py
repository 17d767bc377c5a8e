"""The exception table of the Modbus TCP face, row by row, as a client sees it."""

from __future__ import annotations

from dataclasses import dataclass, field

import pytest

from gateway.core.snapshot import DeviceState
from gateway.errors import (
    DeviceOffline,
    LineDown,
    QueueFull,
    ReplyCrcError,
    ReplyMismatch,
    ReplyTimeout,
    RequestError,
    ShuttingDown,
)

from .conftest import Running, Serve, World, registers


@dataclass(frozen=True)
class Row:
    """A request that is refused without asking the line."""

    name: str
    pdu: str
    reply: str
    unit: int = 11
    settings: dict[str, object] = field(default_factory=dict)


ROWS = [
    *(
        Row(f"unknown-function-{f:02x}", f"{f:02x} 0000 0001", f"{f | 0x80:02x} 01")
        for f in (7, 8, 0x0B, 0x0C, 0x11, 0x14)
    ),
    Row("unknown-function-00", "00", "80 01"),
    Row("unknown-function-7f-alone", "7f", "ff 01"),
    Row("function-with-exception-bit", "83 02", "83 01"),
    Row("write-coil", "05 0000 ff00", "85 01"),
    Row("write-register", "06 e000 0001", "86 01"),
    Row("write-coils", "0f 0000 0008 01 ff", "8f 01"),
    Row("write-registers", "10 e000 0001 02 0001", "90 01"),
    Row("mask-write", "16 e000 00ff 0000", "96 01"),
    Row("read-write-registers", "17 0000 0001 e000 0001 02 0001", "97 01"),
    Row("write-malformed-is-refused-before-it-is-understood", "06 e0", "86 01"),
    Row("past-the-end-by-one", "03 ffff 0002", "83 02"),
    Row("past-the-end-coils", "01 fff9 0008", "81 02"),
    Row("outside-the-map-strict", "03 0052 0001", "83 02", settings={"strict_map": True}),
    Row("across-the-map-edge-strict", "03 0050 0003", "83 02", settings={"strict_map": True}),
    Row("coils-outside-the-map-strict", "01 0100 0001", "81 02", settings={"strict_map": True}),
    Row("quantity-0", "03 0000 0000", "83 03"),
    Row("quantity-126", "03 0000 007e", "83 03"),
    Row("quantity-65535", "04 0000 ffff", "84 03"),
    Row("quantity-0-coils", "01 0000 0000", "81 03"),
    Row("quantity-2001-inputs", "02 0000 07d1", "82 03"),
    Row("quantity-before-address", "03 ffff 007e", "83 03"),
    Row("too-short", "03 0000 00", "83 03"),
    Row("too-long", "03 0000 0001 00", "83 03"),
    Row("function-alone", "03", "83 03"),
    Row("identification-wrong-mei-type", "2b 0d 01 00", "ab 01"),
    Row("identification-without-mei-type", "2b", "ab 03"),
    Row("identification-code-0", "2b 0e 00 00", "ab 03"),
    Row("identification-code-5", "2b 0e 05 00", "ab 03"),
    Row("identification-too-short", "2b 0e 01", "ab 03"),
    Row("unit-0", "03 0000 0001", "83 0a", unit=0),
    Row("unit-0-write", "06 0000 0001", "86 0a", unit=0),
    Row("unit-not-routed", "03 0000 0001", "83 0a", unit=13),
    Row("unit-not-routed-unknown-function", "41", "c1 0a", unit=13),
    *(Row(f"unit-{unit}", "03 0000 0001", "83 0a", unit=unit) for unit in (*range(248, 255), 255)),
]


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.name)
async def test_refused_without_asking_the_line(serve: Serve, world: World, row: Row) -> None:
    running = await serve(**row.settings)
    client = await running.connect()
    reply = await client.query(row.unit, bytes.fromhex(row.pdu))
    assert reply == bytes.fromhex(row.reply)
    assert not any(line.transactions for line in world.lines)
    assert world.stats.exceptions == {reply[1]: 1}
    assert await client.query(12, bytes.fromhex("03 0000 0001")) == b"\x03\x02" + registers(2, 0, 1)


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (ReplyCrcError(), 0x04),
        (ReplyMismatch(), 0x04),
        (QueueFull(), 0x06),
        (ShuttingDown(), 0x06),
        (LineDown(), 0x0A),
        (ReplyTimeout(), 0x0B),
        (DeviceOffline(), 0x0B),
    ],
    ids=lambda value: value.label if isinstance(value, RequestError) else "",
)
async def test_what_the_line_reports_becomes_its_exception(running: Running, error: RequestError, code: int) -> None:
    running.world.line(11).outcomes[1] = error
    client = await running.connect()
    assert await client.query(11, bytes.fromhex("04 0000 0001")) == bytes((0x84, code))
    assert running.world.stats.exceptions == {code: 1}
    assert running.world.stats.forwarded == 1


@pytest.mark.parametrize("code", [0x01, 0x02, 0x03, 0x04, 0x05, 0x06, 0x08, 0x63])
async def test_the_devices_own_exception_passes_through(running: Running, code: int) -> None:
    running.world.line(11).outcomes[1] = bytes((0x83, code))
    client = await running.connect()
    for _ in range(2):
        assert await client.query(11, bytes.fromhex("03 0000 0001")) == bytes((0x83, code))
    assert len(running.world.line(11).transactions) == 2, "an exception is not remembered"


async def test_a_range_outside_the_map_is_the_devices_decision(running: Running) -> None:
    client = await running.connect()
    running.world.poll(11)
    assert await client.query(11, bytes.fromhex("03 0050 0003")) == b"\x83\x02"
    assert running.world.line(11).transactions == [(1, bytes.fromhex("03 0050 0003"))]


async def test_a_quarantined_device_is_0b_at_once(running: Running) -> None:
    running.world.poll(11)
    running.world.set_state(11, DeviceState.OFFLINE)
    client = await running.connect()
    assert await client.query(11, bytes.fromhex("03 0000 0001")) == b"\x83\x0b"
    assert await client.query(11, bytes.fromhex("2b 0e 01 00")) == b"\xab\x0b"
    assert not running.world.line(11).transactions


async def test_a_quarantined_device_on_a_closed_line_is_0a(running: Running) -> None:
    running.world.poll(11)
    running.world.set_state(11, DeviceState.OFFLINE)
    running.world.line(11).open = False
    client = await running.connect()
    assert await client.query(11, bytes.fromhex("03 0000 0001")) == b"\x83\x0a"


async def test_a_stale_device_is_asked_and_not_remembered(running: Running) -> None:
    world = running.world
    world.poll(11)
    world.set_state(11, DeviceState.STALE)
    world.line(11).outcomes[1] = ReplyTimeout()
    client = await running.connect()
    assert await client.query(11, bytes.fromhex("03 0000 0001")) == b"\x83\x0b"
    assert world.line(11).transactions == [(1, bytes.fromhex("03 0000 0001"))]


async def test_a_refused_write_leaves_one_audit_line_without_its_value(
    running: Running, caplog: pytest.LogCaptureFixture
) -> None:
    client = await running.connect()
    for _ in range(3):
        assert await client.query(11, bytes.fromhex("06 e012 beef")) == b"\x86\x01"
    lines = [record.getMessage() for record in caplog.records if "write_refused" in record.getMessage()]
    assert lines == [
        "event=write_refused peer=127.0.0.1 unit=11 function=0x06 address=0xe012 reason=writes_disabled left_out=0"
    ]
    assert running.world.stats.refused == {"writes_disabled": 3}
