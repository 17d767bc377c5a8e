"""Modbus over TLS is Modbus as it is (R-05), for clients that know nothing of this project."""

from __future__ import annotations

import asyncio
import re
import ssl
import subprocess
from collections.abc import Callable

import pytest
from pymodbus.client import AsyncModbusTlsClient

from gateway.faces.modbus.settings import LineListen
from gateway.faces.modbus.tls_files import CIPHERS
from gateway.modbus import mbap
from tests.faces.modbus.conftest import Serve, read, register, registers
from tests.faces.modbus.tls.conftest import ServeTls, TlsSite

pytestmark = pytest.mark.peer

V12, V13 = ssl.TLSVersion.TLSv1_2, ssl.TLSVersion.TLSv1_3


@pytest.mark.parametrize("version", [V12, V13])
async def test_r01_reads_over_both_versions(serve_tls: ServeTls, version: ssl.TLSVersion) -> None:
    site = await serve_tls()
    site.world.poll(12)
    client = await site.connect("reader", version=version)
    for unit in (12, 11, 21):  # from memory, and from both lines
        pdu, reply = read(unit, 3, 70)
        assert await client.query(unit, pdu) == reply
    assert site.stats.handshakes == 1
    assert site.world.stats.requests == 3
    assert site.world.stats.cache_hits == 1


async def test_pipelined_replies_keep_their_order_and_fill_many_records(serve_tls: ServeTls) -> None:
    site = await serve_tls()
    site.world.poll(12)
    client = await site.connect("reader")
    asked = [(tid, (11, 12, 21)[tid % 3], *read((11, 12, 21)[tid % 3], tid % 10, 70)) for tid in range(400)]
    client.send(b"".join(mbap.encode(tid, unit, pdu) for tid, unit, pdu, _ in asked))
    assert await client.adus(400) == [mbap.Adu(tid, unit, reply) for tid, unit, _, reply in asked]


async def test_pymodbus_with_a_certificate(serve_tls: ServeTls) -> None:
    site = await serve_tls()
    host, port = site.running.address
    context = site.pki.client("operator")
    client = AsyncModbusTlsClient(
        host,
        port=port,
        sslctx=context,
        timeout=60,
        retries=0,
    )
    assert await client.connect()
    try:
        reply = await client.read_holding_registers(3, count=77, device_id=21)
        assert reply.registers == [register(1, at) for at in range(3, 80)]
        assert (await client.write_register(0xE000, 1, device_id=11)).exception_code == 1
    finally:
        client.close()


async def s_client(site: TlsSite, program: str, *options: str, request: bytes = b"") -> tuple[bytes, str]:
    """What openssl s_client got back before its input ended, and what it says."""
    host, port = site.running.address
    folder = site.pki.folder
    arguments = [
        *(program, "s_client", "-connect", f"{host}:{port}", "-CAfile", str(folder / "ca.pem"), "-verify_return_error"),
        *("-cert", str(folder / "reader.pem"), "-key", str(folder / "reader.key"), *options),
    ]
    return await asyncio.to_thread(_converse, arguments, request)


def _converse(arguments: list[str], request: bytes) -> tuple[bytes, str]:
    with subprocess.Popen(arguments, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        got = b""
        if request:
            process.stdin.write(request)
            process.stdin.flush()
            got = process.stdout.read(7)
            got += process.stdout.read(int.from_bytes(got[4:6]) - 1)
        out, said = process.communicate(timeout=60)
    return got, (out + said).decode(errors="replace")


REQUEST = mbap.encode(7, 11, read(11, 0, 40)[0])
REPLY = mbap.encode(7, 11, read(11, 0, 40)[1])


@pytest.mark.parametrize(
    "options",
    [
        pytest.param(("-tls1_3",), id="TLS 1.3"),
        pytest.param(("-tls1_2", "-cipher", "ECDHE-ECDSA-AES128-GCM-SHA256"), id="R-62 the suite for ECC"),
        pytest.param(("-curves", "P-256"), id="R-61 P-256"),
        pytest.param(("-tls1_2", "-maxfraglen", "512"), id="R-57 R-58 fragments of 512 bytes"),
    ],
)
async def test_openssl_s_client_reads(
    serve_tls: ServeTls, peer: Callable[[str], str], options: tuple[str, ...]
) -> None:
    site = await serve_tls()
    got, said = await s_client(
        site, peer("openssl"), "-quiet", "-no_ign_eof", "-verify_hostname", "localhost", *options, request=REQUEST
    )
    assert got == REPLY, said


async def test_what_the_handshake_agrees_on(serve_tls: ServeTls, peer: Callable[[str], str]) -> None:
    site = await serve_tls()
    _, said = await s_client(site, peer("openssl"), "-tls1_2")
    assert "Secure Renegotiation IS supported" in said
    assert "Compression: NONE" in said
    assert len(re.findall(r" s:O ?= ?Example", said)) == 2  # the chain down to the root
    assert "Verify return code: 0 (ok)" in said
    assert "Client Certificate Types: " in said  # the client is asked for its certificate
    assert "New, TLSv1.2, Cipher is ECDHE-ECDSA-AES" in said


async def test_rsa_keys_do_with_the_mandatory_suite(
    serve_tls: ServeTls, peer: Callable[[str], str], pki_rsa: None
) -> None:
    site = await serve_tls()
    options = ("-quiet", "-no_ign_eof", "-tls1_2", "-cipher", "ECDHE-RSA-AES128-GCM-SHA256")
    got, said = await s_client(site, peer("openssl"), *options, request=REQUEST)
    assert got == REPLY, said


def test_no_suite_is_weak() -> None:
    for name in CIPHERS:
        assert name.startswith("ECDHE-")  # a new key each time; certificates, never NULL
        assert "GCM" in name or "POLY1305" in name  # R-36, no MD5 or SHA-1


async def test_plain_and_tls_side_by_side_share_what_is_remembered(serve: Serve, serve_tls: ServeTls) -> None:
    site = await serve_tls()
    plain = await serve()
    site.world.poll(12)
    one, other = await site.connect("reader"), await plain.connect()
    pdu, reply = read(12, 0, 5)
    assert await one.query(12, pdu) == await other.query(12, pdu) == reply
    assert reply[2:] == registers(2, 0, 5)


async def test_a_port_that_stands_for_a_line_may_be_behind_tls(serve_tls: ServeTls) -> None:
    lines = (LineListen((("127.0.0.1", 0),), "shelter-b", tls=True),)
    site = await serve_tls(lines=lines)
    assert [listener.label for listener in site.running.server.listeners] == [
        "modbus tls 127.0.0.1:0 line shelter-b",
        "modbus tls 127.0.0.1:0",
    ]
    pdu, reply = read(21, 3, 4)
    by_address, by_unit = await site.connect("reader"), await site.connect("reader", listener=1)
    assert await by_address.query(1, pdu) == reply
    assert await by_address.query(21, pdu) == b"\x83\x0a", "a unit id is no address"
    assert await by_unit.query(21, pdu) == reply
    assert await (await site.connect("norole")).query(1, pdu) == b"\x83\x01"
    plain = await site.running.connect()
    plain.ask(1, 1, pdu)
    await plain.rest()
    assert site.stats.refused == {"not_tls": 1}


async def test_a_line_behind_tls_is_never_open_without_it(serve: Serve) -> None:
    with pytest.raises(ValueError, match="needs the settings of TLS"):
        await serve(lines=(LineListen((("127.0.0.1", 0),), "shelter-a", tls=True),))
