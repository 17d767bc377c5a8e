"""F48: files replaced on disk: new connections use the new ones after SIGHUP; bad ones change nothing and are told."""

from __future__ import annotations

import logging
import re
import shutil
import signal
import socket
import ssl
import urllib.error
import urllib.request
from collections.abc import Callable
from pathlib import Path

import pytest

from gateway.errors import ListenError
from tests.e2e.programs import GATEWAY, Program
from tests.faces.modbus.conftest import Client, read
from tests.faces.modbus.tls.conftest import ServeTls
from tests.faces.modbus.tls.site import SERVER, Pki, role, utf8

pytestmark = pytest.mark.peer

PDU, REPLY = read(11, 0, 4)


def new_certificate(pki: Pki) -> int:
    """Replace the server's certificate and key; the serial number of the new one."""
    pki.issue("renewed", usage=SERVER)
    for suffix in ("pem", "key"):
        shutil.copy(pki.folder / f"renewed.{suffix}", pki.folder / f"server.{suffix}")
    return pki.certificate("server").serial_number


def serial_seen_by(client: Client) -> int:
    seen = client.writer.get_extra_info("ssl_object").getpeercert()
    return int(seen["serialNumber"], 16)


async def test_f48_new_connections_use_the_new_files_and_open_ones_go_on(serve_tls: ServeTls, pki: Pki) -> None:
    site = await serve_tls()
    old = await site.connect("reader")
    serial = new_certificate(pki)
    assert serial_seen_by(await site.connect("reader")) != serial  # what is on disk alone changes nothing
    site.reload()
    new = await site.connect("reader")
    assert serial_seen_by(new) == serial
    assert await new.query(11, PDU) == await old.query(11, PDU) == REPLY
    assert site.stats.problem == ""
    assert site.stats.not_after == pki.certificate("server").not_valid_after_utc.timestamp()


async def test_f48_another_client_authority(serve_tls: ServeTls, pki: Pki) -> None:
    site = await serve_tls()
    pki.authority("new-ca")
    pki.issue("newcomer", issuer="new-ca", extensions=[role(utf8("reader"))])
    reader, newcomer = pki.client("reader"), pki.client("newcomer")  # whom they trust is as before

    async def is_served(context: ssl.SSLContext) -> bool:
        try:
            return await (await site.connect(None, context=context)).query(11, PDU) == REPLY
        except (ssl.SSLError, ConnectionError, EOFError):
            return False

    assert (await is_served(reader), await is_served(newcomer)) == (True, False)
    shutil.copy(pki.folder / "new-ca.pem", pki.folder / "ca.pem")
    site.reload()
    assert (await is_served(reader), await is_served(newcomer)) == (False, True)


BAD: dict[str, Callable[[Pki], object]] = {
    "key_file: .* cannot be read: No such file": lambda pki: (pki.folder / "server.key").unlink(),
    "certificate_file: holds no certificate": lambda pki: (pki.folder / "server.pem").write_text("half a fi"),
    "key_file: is not the key of the first": lambda pki: _copy(pki, "ca.key", "server.key"),
    "key_file: holds no private key": lambda pki: (pki.folder / "server.key").write_bytes(b"\0" * 300),
    "certificate_file: expired on": lambda pki: _issue_server(pki, days=(-2, -1)),
    "certificate_file: is not valid before": lambda pki: _issue_server(pki, days=(1, 2)),
    "certificate_file: is not for servers": lambda pki: shutil.copy(
        pki.folder / "reader.pem", pki.folder / "server.pem"
    ),
    "client_ca_file: holds no certificate": lambda pki: (pki.folder / "ca.pem").write_text(""),
    "crl_file: holds no CRL": lambda pki: (pki.folder / "crl.pem").write_text("-----BEGIN X509 CRL-----"),
}


def _copy(pki: Pki, one: str, other: str) -> None:
    shutil.copy(pki.folder / one, pki.folder / other)


def _issue_server(pki: Pki, days: tuple[float, float]) -> None:
    pki.issue("server", usage=SERVER, days=days)


@pytest.mark.parametrize("problem", BAD)
async def test_f48_bad_files_keep_the_old_ones(
    serve_tls: ServeTls, pki: Pki, caplog: pytest.LogCaptureFixture, tmp_path: Path, problem: str
) -> None:
    good = shutil.copytree(pki.folder, tmp_path / "good")
    site = await serve_tls(crl=True)
    context = pki.client("reader")
    before = serial_seen_by(await site.connect(None, context=context))
    BAD[problem](pki)
    with caplog.at_level(logging.ERROR):
        site.reload()
    (message,) = [text for text in caplog.messages if "tls_reload_failed" in text]
    assert "kept=old" in message
    assert site.stats.reload_failures == 1
    assert re.search(problem, site.stats.problem)
    client = await site.connect(None, context=context)
    assert serial_seen_by(client) == before
    assert await client.query(11, PDU) == REPLY
    shutil.copytree(good, pki.folder, dirs_exist_ok=True)
    site.reload()
    assert site.stats.problem == ""


async def test_f48_files_that_are_missing_at_the_start_keep_only_the_port_closed(serve_tls: ServeTls, pki: Pki) -> None:
    site = await serve_tls()
    (listener,) = site.running.server.listeners
    await listener.stop()
    fresh = await serve_tls()  # files are there: a second server starts
    assert fresh.running.address
    shutil.move(pki.folder / "server.key", pki.folder / "away")
    with pytest.raises(ListenError, match=r"modbus tls 127.0.0.1:0: key_file: .* cannot be read"):
        await serve_tls()
    assert "cannot be read" in site.stats.problem
    shutil.move(pki.folder / "away", pki.folder / "server.key")
    assert (await serve_tls()).running.address


async def test_f48_a_revoked_clients_connection_ends_with_the_reload(serve_tls: ServeTls, pki: Pki) -> None:
    site = await serve_tls(crl=True)
    revoked, other = await site.connect("operator"), await site.connect("reader")
    pki.revoke()
    site.reload()
    assert await revoked.rest() == b""
    assert await other.query(11, PDU) == REPLY
    assert site.world.stats.closed["certificate_revoked"] == 1


CONFIG = """
site = "ridge-07"
state_dir = "{folder}"
[[line]]
name = "shelter-a"
port = "{folder}/no-such-port"
  [[line.device]]
  name = "array-1"
  address = 1
  unit_id = 11
  model = "prostar-mppt"
[modbus]
listen = []
[modbus.tls]
listen = ["127.0.0.1:0"]
certificate_file = "{folder}/pki/server.pem"
key_file = "{folder}/pki/server.key"
client_ca_file = "{folder}/pki/ca.pem"
crl_file = "{folder}/pki/crl.pem"
[snmp]
listen = []
[http]
listen = ["127.0.0.1:0"]
[history]
enabled = false
"""


def serial_at(port: int, context: ssl.SSLContext) -> int:
    with (
        socket.create_connection(("127.0.0.1", port), timeout=60) as plain,
        context.wrap_socket(plain, server_hostname="localhost") as sock,
    ):
        certificate = sock.getpeercert()
        assert certificate is not None
        return int(str(certificate["serialNumber"]), 16)


def get(port: int, path: str) -> tuple[int, str]:
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}{path}", timeout=60) as reply:
            return reply.status, reply.read().decode()
    except urllib.error.HTTPError as error:
        with error:
            return error.code, error.read().decode()


def test_f48_sighup_reaches_the_running_gateway(tmp_path: Path, pki: Pki) -> None:
    config = tmp_path / "site.toml"
    config.write_text(CONFIG.format(folder=tmp_path))
    program = Program([*GATEWAY, "run", "-c", str(config)])
    try:
        ports = {}
        for _ in range(2):
            line = program.wait_for(r'event=listening listener="(modbus tls|http) ')
            ports["tls" if "modbus tls" in line else "http"] = int(line.rpartition(":")[2])
        context = pki.client("reader")
        assert serial_at(ports["tls"], context) == pki.certificate("server").serial_number
        assert get(ports["http"], "/readyz")[0] == 200

        serial = new_certificate(pki)
        program.process.send_signal(signal.SIGHUP)
        program.wait_for("event=tls_reloaded")
        assert serial_at(ports["tls"], context) == serial

        (pki.folder / "server.key").write_text("no key")
        program.process.send_signal(signal.SIGHUP)
        program.wait_for("event=tls_reload_failed kept=old .*key_file: holds no private key")
        assert serial_at(ports["tls"], context) == serial
        status, shown = get(ports["http"], "/readyz")
        assert status == 503
        assert "modbus tls cannot use its files: key_file: holds no private key" in shown
        metrics = get(ports["http"], "/metrics")[1]
        assert "prostar_gateway_modbus_tls_reload_failures_total 1" in metrics
        assert "prostar_gateway_modbus_tls_files_in_use 0" in metrics
        assert "prostar_gateway_modbus_tls_handshakes_total 3" in metrics
    finally:
        assert program.end() == 0
