"""F40: random bytes and mutated streams end only in what is documented, and the server goes on."""

from __future__ import annotations

import asyncio
import contextlib

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from gateway.clock import SystemClock
from gateway.core.stats import ModbusServerStats
from gateway.faces.modbus.server import ModbusServer
from gateway.faces.modbus.settings import ModbusSettings
from gateway.modbus import mbap
from tests.faces.modbus.conftest import Client, World, registers

DOCUMENTED = {1, 2, 3, 4, 6, 0x0A, 0x0B}
SIZES = st.integers(0, 0xFFFF) | st.integers(0, 130)

pdus = st.one_of(
    st.builds(
        lambda function, first, count: bytes((function,)) + first.to_bytes(2) + count.to_bytes(2),
        st.sampled_from((1, 2, 3, 4)),
        SIZES,
        SIZES,
    ),
    st.builds(lambda code, number: bytes((0x2B, 0x0E, code, number)), st.integers(0, 255), st.integers(0, 255)),
    st.binary(min_size=1, max_size=253),
)
requests = st.builds(mbap.encode, st.integers(0, 0xFFFF), st.sampled_from((0, 11, 12, 12, 12, 21, 99, 250, 255)), pdus)


@st.composite
def streams(draw: st.DrawFn) -> bytes:
    """Whole requests, then bits flipped, bytes cut out, doubled or put in."""
    stream = bytearray(b"".join(draw(st.lists(requests, min_size=1, max_size=12))))
    for _ in range(draw(st.integers(0, 4))):
        at = draw(st.integers(0, max(0, len(stream) - 1)))
        match draw(st.sampled_from(("flip", "cut", "double", "insert"))):
            case "flip" if stream:
                stream[at] ^= 1 << draw(st.integers(0, 7))
            case "cut":
                del stream[at : at + draw(st.integers(1, 12))]
            case "double":
                stream[at:at] = stream[at : at + draw(st.integers(1, 24))]
            case _:
                stream[at:at] = draw(st.binary(min_size=1, max_size=12))
    return bytes(stream)


def expected(stream: bytes) -> tuple[list[tuple[int, int, int]], str | None]:
    """Transaction id, unit and function of each request that must be answered, and why the stream ends early."""
    out: list[tuple[int, int, int]] = []
    at, run = 0, 0
    while len(stream) - at >= 6:
        tid, protocol, length = (int.from_bytes(stream[at + i : at + i + 2]) for i in (0, 2, 4))
        if not 2 <= length <= 254:
            return out, "length"
        if at + 6 + length > len(stream):
            break
        if protocol:
            run += 1
            if run == 3:
                return out, "protocol"
        else:
            run = 0
            out.append((tid, stream[at + 6], stream[at + 7]))
        at += 6 + length
    return out, None


async def exchange(world: World, stream: bytes, cuts: list[int]) -> tuple[list[mbap.Adu], bytes, ModbusServerStats]:
    """Send the stream in pieces, then end it; the replies, what is left over, and the counters."""
    stats = ModbusServerStats()
    server = ModbusServer(ModbusSettings(listen=(("127.0.0.1", 0),)), world.site, SystemClock(), stats)
    listener = server.listeners[0]
    await listener.start()
    assert listener.bound is not None
    client = Client(*await asyncio.open_connection(*listener.bound))
    at = 0
    for cut in [*sorted(cut for cut in cuts if cut < len(stream)), len(stream)]:
        client.send(stream[at:cut])
        at = cut
        await asyncio.sleep(0)
    with contextlib.suppress(OSError):  # the server may have ended it already
        client.writer.write_eof()
    splitter = mbap.MbapSplitter()
    replies = splitter.feed(await client.rest())
    await client.close()

    after = Client(*await asyncio.open_connection(*listener.bound))
    assert await after.query(12, bytes.fromhex("03 0000 0001")) == b"\x03\x02" + registers(2, 0, 1)
    await after.close()
    await listener.stop()
    server.clients.settle()
    assert splitter.lost is None
    return replies, bytes(splitter.pending), stats


@pytest.mark.parametrize("cached", [False, True])
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow], max_examples=60)
@given(stream=streams(), cuts=st.lists(st.integers(1, 200), max_size=5))
def test_mutated_streams_give_only_documented_outcomes(
    world: World, cached: bool, stream: bytes, cuts: list[int]
) -> None:
    if cached:
        world.clock.now = SystemClock().monotonic()
        world.poll(12)
    replies, left_over, stats = asyncio.run(exchange(world, stream, cuts))
    asked, lost = expected(stream)
    assert left_over == b""
    if lost is None:  # a lost framing may come back as a reset, which takes replies on the way with it
        assert len(replies) == len(asked)
    for reply, (tid, unit, function) in zip(replies, asked, strict=False):
        assert (reply.tid, reply.unit) == (tid, unit)
        if reply.pdu[0] & 0x80:
            assert reply.pdu[0] == function | 0x80
            assert reply.pdu[1] in DOCUMENTED
        else:
            assert reply.pdu[0] == function
            assert function in {1, 2, 3, 4, 0x2B}
    assert stats.requests == len(asked) + 1
    assert stats.closed["error"] == 0
    assert stats.closed["framing_lost"] == (lost is not None)
