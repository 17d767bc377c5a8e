"""F50: no secret shows: not in logs, argv, environment, /metrics, any other page, check-config, the configuration as
text, what is kept on disk, nor in a core dump.

The secrets are used, rightly and wrongly, while everything that the gateway gives out is collected.
"""

from __future__ import annotations

import base64
import contextlib
import http.client
import pprint
import resource
import shutil
import ssl
import subprocess
from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID

from gateway.service.config import load_config
from gateway.service.settings import http_settings, modbus_settings
from gateway.service.snmp import snmp_settings
from tests.e2e.programs import GATEWAY, Program, environment, write_config

pytestmark = pytest.mark.peer

SECRETS = {
    "auth": "correct-horse-auth-1",
    "priv": "battery-staple-priv-2",
    "community": "k7-zebra-community",
    "password": "tulip-password-3",
    "token": "magenta-token-4-5-6",
}
SNMP_USER = """
[[snmp.user]]
name = "noc"
auth = "SHA-256"
auth_password_file = "{folder}/secret.auth"
priv = "AES-128"
priv_password_file = "{folder}/secret.priv"
source = ["127.0.0.1/32"]
"""
HTTP = """
basic_auth_file = "{folder}/secret.users"
bearer_token_file = "{folder}/secret.token"
tls_certificate = "{folder}/http.crt"
tls_private_key = "{folder}/secret.key"
"""


class Site:
    """A gateway with secrets in files, and everything it gave out."""

    def __init__(self, folder: Path, ports: tuple[int, int, int]) -> None:
        self.folder = folder
        self.modbus, self.snmp, self.http = ports
        self.config = folder / "site.toml"
        self.given: dict[str, str] = {}
        self.key = _certificate(folder)
        (folder / "secret.auth").write_text(f"{SECRETS['auth']}\n")
        (folder / "secret.priv").write_text(f"{SECRETS['priv']}\n")
        (folder / "secret.users").write_text(f"ops:{SECRETS['password']}\n")
        (folder / "secret.token").write_text(f"{SECRETS['token']}\n")
        for path in folder.glob("secret.*"):
            path.chmod(0o600)
        write_config(self.config, ports, (("shelter-a", "array-1", 1, 11),))
        text = self.config.read_text().replace('name = "public"', f'name = "{SECRETS["community"]}"')
        listen = f'[http]\nlisten = ["127.0.0.1:{self.http}"]\n'
        assert listen in text
        text = text.replace(listen, listen + HTTP.format(folder=folder)) + SNMP_USER.format(folder=folder)
        self.config.write_text(text)

    def command(self, *arguments: str) -> None:
        """Collect what a command prints."""
        done = subprocess.run(
            [*GATEWAY, *arguments, "-c", str(self.config)], capture_output=True, text=True, check=False
        )
        self.given[" ".join(arguments)] = done.stdout + done.stderr

    def page(self, path: str, authorization: str) -> int:
        """Collect a page; gives its status."""
        context = ssl.create_default_context(cafile=str(self.folder / "http.crt"))
        connection = http.client.HTTPSConnection("localhost", self.http, context=context, timeout=60)
        with contextlib.closing(connection):
            connection.request("GET", path, headers={"Authorization": authorization} if authorization else {})
            reply = connection.getresponse()
            self.given[f"{path} {reply.status}"] = f"{reply.headers}{reply.read().decode('utf-8', 'replace')}"
            return reply.status

    def process(self, pid: int) -> None:
        """Collect what other users of the machine can see of the process."""
        for name in ("cmdline", "environ", "limits"):
            self.given[name] = Path(f"/proc/{pid}/{name}").read_text(errors="replace")


def _certificate(folder: Path) -> str:
    """Write a certificate for localhost and its key; gives the secret part of the key's text."""
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "localhost")])
    now = datetime.now(UTC)
    certificate = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - timedelta(days=1))
        .not_valid_after(now + timedelta(days=1))
        .add_extension(x509.SubjectAlternativeName([x509.DNSName("localhost")]), critical=False)
        .add_extension(x509.BasicConstraints(ca=True, path_length=None), critical=True)
        .sign(key, hashes.SHA256())
    )
    (folder / "http.crt").write_bytes(certificate.public_bytes(serialization.Encoding.PEM))
    text = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    ).decode()
    (folder / "secret.key").write_text(text)
    return text.splitlines()[1]


def _basic(password: str) -> str:
    return "Basic " + base64.b64encode(f"ops:{password}".encode()).decode()


@pytest.fixture
def running(
    tmp_path: Path, free_tcp_port: Callable[[], int], free_udp_port: Callable[[], int]
) -> Iterator[tuple[Site, Program]]:
    site = Site(tmp_path, (free_tcp_port(), free_udp_port(), free_tcp_port()))
    prlimit = shutil.which("prlimit", path="/usr/bin:/bin")
    assert prlimit is not None
    core = resource.getrlimit(resource.RLIMIT_CORE)[1]  # as much as may be, so that none is the gateway's own doing
    most = f"--core={'unlimited' if core == resource.RLIM_INFINITY else core}"
    program = Program([prlimit, most, *GATEWAY, "run", "--log-level", "debug", "-c", str(site.config)])
    try:
        yield site, program
    finally:
        if program.process.returncode is None:
            program.end()


def _ask(snmpget: str, port: int, *who: str) -> bool:
    """Whether sysName was given to this user or community."""
    command = [snmpget, "-r", "0", "-t", "1", *who, f"127.0.0.1:{port}", "1.3.6.1.2.1.1.5.0"]
    return "STRING" in subprocess.run(command, capture_output=True, text=True, check=False, env=environment()).stdout


def test_no_secret_is_in_anything_that_is_given_out(running: tuple[Site, Program], peer: Callable[[str], str]) -> None:
    site, program = running
    for _ in range(2):
        program.wait_for("event=listening .*(http|snmp)")
    v3 = ("-v3", "-l", "authPriv", "-u", "noc", "-a", "SHA-256", "-x", "AES", "-A")
    snmpget = peer("snmpget")
    assert _ask(snmpget, site.snmp, *v3, SECRETS["auth"], "-X", SECRETS["priv"])
    assert not _ask(snmpget, site.snmp, *v3, "wrong-horse-auth", "-X", SECRETS["priv"])
    assert not _ask(snmpget, site.snmp, *v3, SECRETS["auth"], "-X", "wrong-staple-priv")
    assert _ask(snmpget, site.snmp, "-v2c", "-c", SECRETS["community"])
    assert not _ask(snmpget, site.snmp, "-v2c", "-c", SECRETS["community"] + "x")
    for path in ("/metrics", "/", "/healthz", "/readyz", "/sd", "/api/v1/log", "/nothing-here"):
        for authorization in (_basic(SECRETS["password"]), f"Bearer {SECRETS['token']}"):
            assert site.page(path, authorization) != 401
    for authorization in ("", _basic(SECRETS["password"] + "x"), f"Bearer {SECRETS['token']}x", _basic("")):
        assert site.page("/metrics", authorization) == 401
    for arguments in (("check-config",), ("writes",)):
        site.command(*arguments)
    assert "is right" in site.given["check-config"]
    site.process(program.process.pid)
    assert program.end() == 0
    site.given["log"] = program.log()
    assert "event=stopped" in site.given["log"]

    config = load_config(site.config)
    for what in (config, http_settings(config), modbus_settings(config), snmp_settings(config)):
        site.given[f"text of {type(what).__name__}"] = f"{what}\n{what!r}\n{pprint.pformat(what)}"
    for kept in (each for each in (site.folder / "state").rglob("*") if each.is_file()):
        site.given[f"file {kept.name}"] = kept.read_bytes().decode("latin-1")
    assert "morningstar_up" in site.given["/metrics 200"]

    hidden = {**SECRETS, "key": site.key, "basic": _basic(SECRETS["password"]).split()[1]}
    site.given["the file itself"] = site.config.read_text()
    shown = [(where, name) for where, text in site.given.items() for name, secret in hidden.items() if secret in text]
    assert shown == [("the file itself", "community")], "SNMP v2c has no secret, and its community stands there"


def test_a_crash_leaves_no_core(running: tuple[Site, Program]) -> None:
    site, program = running
    program.wait_for("event=started")
    site.process(program.process.pid)
    (line,) = [line for line in site.given["limits"].splitlines() if line.startswith("Max core file size")]
    assert line.split()[4] == "0"


@pytest.mark.parametrize(
    "written",
    [
        ('auth_password = "correct-horse-auth-1"', 'priv_password = "battery-staple-priv-2"'),
        ('auth_password_file = "battery staple 2"', 'basic_auth_file = "ops:tulip-password-3"'),
        ('auth_password_file = "correct-horse-auth-1"',),  # it looks like the name of a credential
    ],
)
def test_a_secret_in_the_wrong_place_is_not_repeated(
    tmp_path: Path, written: tuple[str, ...], free_tcp_port: Callable[[], int], free_udp_port: Callable[[], int]
) -> None:
    """Each key and kind of value: tests/service/test_misplaced_secrets.py."""
    site = Site(tmp_path, (free_tcp_port(), free_udp_port(), free_tcp_port()))
    lines = site.config.read_text().splitlines()
    for text in written:
        key = text.split(" ")[0]
        at = next((n for n, line in enumerate(lines) if line.startswith(f"{key} =")), len(lines))
        lines[at : at + 1] = [text]
    site.config.write_text("\n".join(lines))
    for command in ("check-config", "run"):
        site.command(command)
    assert all(text.split(" ")[0] in given for text in written for given in site.given.values())
    secrets = ("correct-horse", "staple", "tulip")
    assert [given for given in site.given.values() if any(secret in given for secret in secrets)] == []
