"""F47: a session outlives neither its role nor its certificate, because none is ever resumed."""

from __future__ import annotations

import asyncio
import socket
import ssl
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.faces.modbus.conftest import read
from tests.faces.modbus.tls.conftest import ServeTls
from tests.faces.modbus.tls.site import Pki
from tests.faces.modbus.tls.test_tls_serving import s_client

pytestmark = pytest.mark.peer

PDU, REPLY = read(11, 0, 4)
V12, V13 = ssl.TLSVersion.TLSv1_2, ssl.TLSVersion.TLSv1_3


def _ask(
    context: ssl.SSLContext, address: tuple[str, int], session: ssl.SSLSession | None
) -> tuple[ssl.SSLSession | None, bool | None]:
    """Connect with an earlier session, read once; what there is to resume with, and whether it was resumed."""
    with (
        socket.create_connection(address, timeout=60) as plain,
        context.wrap_socket(plain, server_hostname="localhost", session=session) as sock,
    ):
        sock.sendall(b"\0\7\0\0\0\6\13" + PDU)
        assert sock.recv(260)[7:] == REPLY
        return sock.session, sock.session_reused


@pytest.mark.parametrize("version", ["-tls1_2", "-tls1_3"])
@pytest.mark.parametrize("tickets", [(), ("-no_ticket",)])
async def test_f47_a_client_that_tries_to_resume_shakes_hands_in_full(
    serve_tls: ServeTls, peer: Callable[[str], str], tmp_path: Path, version: str, tickets: tuple[str, ...]
) -> None:
    site = await serve_tls()
    openssl, kept = peer("openssl"), tmp_path / "session.pem"
    first = ("-quiet", "-no_ign_eof", version, *tickets, "-sess_out", str(kept))
    got, _ = await s_client(site, openssl, *first, request=b"\0\7\0\0\0\6\13" + PDU)
    assert got[7:] == REPLY
    if version == "-tls1_3":
        assert not kept.exists()  # no ticket came: there is nothing to resume with
        return
    _, said = await s_client(site, openssl, version, *tickets, "-sess_in", str(kept))
    assert "New, TLSv1.2" in said
    assert "Reused" not in said
    await site.running.until(lambda: site.stats.handshakes == 2)


@pytest.mark.parametrize("version", [V12, V13])
async def test_f47_a_session_offered_by_python_is_not_taken(serve_tls: ServeTls, version: ssl.TLSVersion) -> None:
    site = await serve_tls()
    host, port = site.running.address
    context = site.pki.client("operator", version)
    session: ssl.SSLSession | None = None
    for _ in range(3):
        session, reused = await asyncio.to_thread(_ask, context, (host, port), session)
        assert not reused
        assert session is None or not session.has_ticket
    assert site.stats.handshakes == 3


async def test_f47_the_certificate_is_looked_at_each_time(serve_tls: ServeTls, pki: Pki) -> None:
    site = await serve_tls(crl=True)
    context = pki.client("operator", V12)
    first = await site.connect(None, context=context)
    assert await first.query(11, PDU) == REPLY
    pki.revoke()
    site.reload()
    with pytest.raises((ssl.SSLError, ConnectionError, EOFError)):
        await (await site.connect(None, context=context)).query(11, PDU)
    assert site.stats.refused == {"certificate_revoked": 1}
