"""F07: 1 to 300 bytes of noise before the reply, bytes that look like unit and function among them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pytest

from gateway.modbus.collector import MAX_BUFFER, Collector, Echo
from gateway.modbus.frames import Exchange
from gateway.simulator.medium import Burst, CleanMedium
from tests.faults.pty_rig import running
from tests.faults.rig import MakeRig, frame, read

PATTERNS = {
    "zeros": b"\x00",
    "ones": b"\xff",
    "unit": b"\x01",
    "unit and function": b"\x01\x03",
    "head of the reply": b"\x01\x03\x08",
    "modem commands": b"AT\r\n",
    "anything": bytes(range(256)) * 2,
}


class Noisy(CleanMedium):
    """`noise` before every reply."""

    noise = b""

    def reply(self, frame_: bytes, starts_at: float) -> Sequence[Burst]:
        return (Burst(starts_at, self.noise + frame_),)


@pytest.mark.parametrize("pattern", PATTERNS.values(), ids=PATTERNS)
def test_the_frame_is_found_at_any_offset_without_a_time_out(rig: MakeRig, pattern: bytes) -> None:
    medium = Noisy()
    line = rig(medium=medium)
    counted = 0
    for size in (1, 2, 3, 4, 5, 8, 13, 64, 199, 255, 256, 257, 300):
        medium.noise = (pattern * size)[:size]
        assert isinstance(line.ask(0, read(size, 4) if size < 70 else read(0, 4)), bytes)
        wire = line.engine.stats.wire
        seen = wire.noise_bytes + 13 * (wire.crc_errors + wire.mismatch) + wire.late_bytes
        assert seen > counted
        counted = seen
    assert line.engine.stats.failed["timeout"] == 0
    assert line.engine.stats.failed["crc"] == 0


def test_a_flood_is_kept_in_512_bytes_and_counted_whole() -> None:
    collector = Collector(Exchange.of(1, read(0, 4)), Echo.UNKNOWN)
    for _ in range(100):
        assert collector.take(b"\x01\x03\x08" * 37) is None
        assert collector.pending <= MAX_BUFFER == 512
    reply = frame(1, bytes.fromhex("03 08 1111 2222 3333 4444"))
    taken = collector.take(b"\x01" * 300 + reply)
    assert taken is not None
    assert taken[0] == reply[1:-2]
    assert collector.seen.noise_bytes + 13 * collector.seen.damaged >= 100 * 111 - 512


@pytest.mark.parametrize("pattern", [PATTERNS["head of the reply"], PATTERNS["anything"]], ids=["head", "anything"])
async def test_over_a_pty(tmp_path: Path, pattern: bytes) -> None:
    medium = Noisy()
    async with running(tmp_path, medium=medium) as line:
        await line.online()
        for size in (1, 2, 7, 100, 300):
            medium.noise = (pattern * size)[:size]
            assert isinstance(await line.ask(0, read(0, 4)), bytes)
        assert line.line.stats.failed["timeout"] == 0
