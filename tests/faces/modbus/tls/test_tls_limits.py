"""What a slow, broken or greedy client can do to a TLS listener, and what it cannot do to the others."""

from __future__ import annotations

import asyncio
import socket
import ssl
import time
from ipaddress import ip_network

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from gateway.core.ratelimit import ClientRate
from gateway.faces.modbus.connection import MAX_UNSENT
from gateway.faces.modbus.settings import RateSettings
from gateway.faces.modbus.tls_session import _Records
from gateway.modbus import mbap
from tests.faces.modbus.conftest import Client, read
from tests.faces.modbus.tls.conftest import ServeTls, TlsSite

pytestmark = pytest.mark.peer

PDU, REPLY = read(11, 0, 4)
REQUEST = mbap.encode(1, 11, PDU)


class Hand:
    """A TLS client whose bytes a test sends as it likes."""

    def __init__(self, site: TlsSite, client: Client) -> None:
        self.client = client
        self.incoming, self.outgoing = ssl.MemoryBIO(), ssl.MemoryBIO()
        context = site.pki.client("reader")
        self.tls = context.wrap_bio(self.incoming, self.outgoing, server_hostname="localhost")

    @classmethod
    async def of(cls, site: TlsSite) -> Hand:
        return cls(site, await site.running.connect())

    async def shake(self, pieces: int = 1 << 20) -> None:
        while True:
            try:
                self.tls.do_handshake()
            except ssl.SSLWantReadError:
                await self.send(self.outgoing.read(), pieces)
                self.incoming.write(await self.client.reader.read(65536))
            else:
                await self.send(self.outgoing.read(), pieces)
                return

    def sealed(self, data: bytes) -> bytes:
        self.tls.write(data)
        return self.outgoing.read()

    async def send(self, data: bytes, pieces: int = 1 << 20) -> None:
        for at in range(0, len(data), pieces):
            self.client.send(data[at : at + pieces])
            await asyncio.sleep(0)

    async def received(self, size: int) -> bytes:
        got = b""
        async with asyncio.timeout(30):
            while len(got) < size:
                try:
                    got += self.tls.read(65536)
                except ssl.SSLWantReadError:
                    self.incoming.write(await self.client.reader.read(65536))
        return got


async def test_byte_by_byte_is_as_good_as_at_once(serve_tls: ServeTls) -> None:
    hand = await Hand.of(await serve_tls())
    await hand.shake(pieces=1)
    await hand.send(hand.sealed(REQUEST * 3), pieces=1)
    assert await hand.received(3 * len(REPLY) + 21) == mbap.encode(1, 11, REPLY) * 3


async def test_records_end_where_they_like_and_share_segments(serve_tls: ServeTls) -> None:
    hand = await Hand.of(await serve_tls())
    await hand.shake()
    pieces = [REQUEST[:3], REQUEST[3:] + REQUEST + REQUEST[:1], REQUEST[1:]]
    await hand.send(b"".join(map(hand.sealed, pieces)))
    assert await hand.received(3 * len(REPLY) + 21) == mbap.encode(1, 11, REPLY) * 3


async def test_a_handshake_that_does_not_come_ends_and_delays_nobody(serve_tls: ServeTls) -> None:
    site = await serve_tls(tls={"handshake_timeout_s": 1.0})
    silent = await site.running.connect()
    slow = await Hand.of(site)
    with pytest.raises(ssl.SSLWantReadError):
        slow.tls.do_handshake()
    await slow.send(slow.outgoing.read()[:100])  # half of its first message
    quick = await site.connect("reader")
    for _ in range(20):
        assert await quick.query(11, PDU) == REPLY
    assert site.stats.refused.total() == 0  # they still wait
    assert await silent.rest() == await slow.client.rest() == b""
    assert site.stats.refused == {"timeout": 2}
    assert site.world.stats.closed == {"tls_refused": 2}


async def test_f30_a_record_that_is_not_completed_ends_its_connection(serve_tls: ServeTls) -> None:
    site = await serve_tls(frame_timeout_s=0.1)
    hand = await Hand.of(site)
    await hand.shake()
    await hand.send(hand.sealed(REQUEST)[:-1])
    await hand.client.rest()
    assert site.world.stats.closed == {"slow_frame": 1}


async def test_the_first_request_does_not_wait_for_a_delayed_acknowledgement(serve_tls: ServeTls) -> None:
    site = await serve_tls()
    context = site.pki.client("reader", ssl.TLSVersion.TLSv1_3)
    took_s = [await asyncio.to_thread(_first_request, context, site.running.address)]
    while took_s[-1] >= 0.035 and len(took_s) < 50:  # the one of a moment when the machine is not busy counts
        took_s.append(await asyncio.to_thread(_first_request, context, site.running.address))
    assert min(took_s) < 0.035  # Linux acknowledges after 40 ms unless told otherwise


def _first_request(context: ssl.SSLContext, address: tuple[str, int]) -> float:
    with (
        socket.create_connection(address, timeout=60) as plain,  # with Nagle's algorithm, as by default
        context.wrap_socket(plain, server_hostname="localhost") as sock,
    ):
        began = time.perf_counter()
        sock.sendall(REQUEST)
        assert sock.recv(260)[7:] == REPLY
        return time.perf_counter() - began


async def test_f35_a_client_that_only_shakes_hands_is_cut_off_before_it_can(serve_tls: ServeTls) -> None:
    rate = RateSettings(client=ClientRate(requests_per_s=100.0), burst_s=2.0, networks=())
    site = await serve_tls(rate=rate)
    for _ in range(2):
        await site.connect("reader")
    for _ in range(3):
        assert await (await site.running.connect()).rest() == b""
    assert site.stats.handshakes == 2
    assert site.stats.refused == {"rate_limited": 3}
    site.world.clock.now += 2
    assert await (await site.connect("reader")).query(11, PDU) == REPLY


async def test_f49_a_stranger_is_cut_off_before_the_handshake(serve_tls: ServeTls) -> None:
    site = await serve_tls(allow=(ip_network("192.0.2.0/24"),))
    client = await site.running.connect()
    assert await client.rest() == b""
    assert site.world.stats.closed == {"not_allowed": 1}
    assert site.stats.refused.total() == 0


async def test_f32_handshakes_count_as_connections(serve_tls: ServeTls) -> None:
    site = await serve_tls(max_connections=2)
    open_one, silent = await site.connect("reader"), await site.running.connect()
    await site.running.until(lambda: site.world.stats.open_connections == 2)
    third = await site.running.connect()
    assert await third.rest() == b""
    assert site.world.stats.closed == {"full": 1}
    await silent.close()
    await site.running.until(lambda: site.world.stats.open_connections == 1)
    assert site.stats.refused == {"hung_up": 1}
    assert await (await site.connect("reader")).query(11, PDU) == REPLY
    assert await open_one.query(11, PDU) == REPLY


async def test_a_reset_in_the_middle_of_a_handshake(serve_tls: ServeTls) -> None:
    site = await serve_tls()
    hand = await Hand.of(site)
    with pytest.raises(ssl.SSLWantReadError):
        hand.tls.do_handshake()
    await hand.send(hand.outgoing.read())
    await hand.client.reader.read(1)
    hand.client.reset()
    await site.running.until(lambda: site.world.stats.open_connections == 0)
    assert site.stats.refused == {"hung_up": 1}


async def test_f34_what_was_asked_before_the_end_is_answered(serve_tls: ServeTls) -> None:
    site = await serve_tls()
    site.world.line(11).held = True
    hand = await Hand.of(site)
    await hand.shake()
    request = hand.sealed(REQUEST)
    with pytest.raises(ssl.SSLWantReadError):
        hand.tls.unwrap()  # "that was all", which under TLS is not the end of the connection
    await hand.send(request + hand.outgoing.read())
    await site.running.until(lambda: len(site.world.line(11).waiting) == 1)
    site.world.line(11).release()
    rest = await hand.client.rest()
    assert len(rest) > len(REPLY)
    hand.incoming.write(rest)
    assert hand.tls.read(300) == mbap.encode(1, 11, REPLY)


async def test_the_end_of_the_gateway_is_said_in_tls(serve_tls: ServeTls) -> None:
    site = await serve_tls(stop_grace_s=1.0)
    site.world.line(11).held = True
    client = await site.connect("reader")
    client.ask(1, 11, PDU)
    await site.running.until(lambda: len(site.world.line(11).waiting) == 1)
    stopping = asyncio.create_task(site.running.server.listeners[0].stop())
    await asyncio.sleep(0)
    site.world.line(11).release()
    assert (await client.adu()).pdu == REPLY
    assert await client.rest() == b""  # no truncation is reported
    await stopping


@pytest.mark.parametrize("in_a_record", [1, 64, 1365])
async def test_f31_a_client_that_takes_no_replies_is_paused(serve_tls: ServeTls, in_a_record: int) -> None:
    site = await serve_tls()
    site.world.poll(12)
    hand, other = await Hand.of(site), await site.connect("reader")
    await hand.shake()
    hand.client.writer.transport.pause_reading()  # type: ignore[attr-defined]  # streams say WriteTransport
    request = mbap.encode(1, 12, read(12, 0, 80)[0]) * in_a_record
    while all(session.connection._unsent_since is None for session in site.door._sessions):
        hand.client.send(b"".join(hand.sealed(request) for _ in range(1365 // in_a_record)))
        await asyncio.sleep(0)
        assert site.world.stats.requests < 1 << 18
    (session,) = [session for session in site.door._sessions if session.connection._unsent_since is not None]
    assert not session.is_reading()
    assert 0 < session.get_write_buffer_size() <= MAX_UNSENT
    assert await other.query(11, PDU) == REPLY
    hand.client.reset()


@pytest.mark.parametrize(
    "tail", [b"\0" * 50, b"\x17\3\3\0\x20" + b"x" * 32, b"\x15\3\3\0\2\2\x28", b"\x17\3\3\xff\xff"]
)
async def test_garbage_after_the_handshake_ends_only_its_connection(serve_tls: ServeTls, tail: bytes) -> None:
    site = await serve_tls(frame_timeout_s=0.1)
    hand, other = await Hand.of(site), await site.connect("reader")
    await hand.shake()
    await hand.send(tail)
    await hand.client.rest()
    assert await other.query(11, PDU) == REPLY
    assert set(site.world.stats.closed) <= {"tls_broken", "slow_frame"}


@given(st.lists(st.integers(0, 300), max_size=8), st.data())
@settings(suppress_health_check=[HealthCheck.too_slow])
def test_records_are_followed_however_they_are_cut(sizes: list[int], data: st.DataObject) -> None:
    stream = b"".join(b"\x17\3\3" + size.to_bytes(2) + bytes(size) for size in sizes)
    ends = {0}
    for size in sizes:
        ends.add(max(ends) + 5 + size)
    records, at = _Records(), 0
    for cut in [*sorted(data.draw(st.lists(st.integers(0, len(stream)), max_size=10))), len(stream)]:
        records.feed(stream[at:cut])
        at = cut
        assert records.partial is (at not in ends)
