"""Modbus/TCP Security as its user has it: `run` with certificates of the documented recipe, pymodbus as the client."""

from __future__ import annotations

import re
import subprocess
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from pymodbus.client import ModbusTlsClient

from gateway.core.write_ledger import Fate, entries
from gateway.devices.schema import load_map
from gateway.faces.modbus.ledger import read_ledger
from tests.e2e.programs import GATEWAY, Launch, Running, environment
from tests.faces.modbus.tls.site import Pki

pytestmark = pytest.mark.peer

ABSORPTION = load_map("prostar-mppt").point("absorption_voltage").address
VALUE = 0x4B64
TLS = """
[modbus.tls]
listen = ["127.0.0.1:{by_unit}"]
certificate_file = "{folder}/server.pem"
key_file = "{folder}/server.key"
client_ca_file = "{folder}/ca.pem"
crl_file = "{folder}/crl.pem"

[[modbus.listener]]
listen = ["127.0.0.1:{by_address}"]
line = "shelter-a"
tls = true

[[modbus.write]]
role = ["operator"]
point = ["absorption_voltage"]
"""


class Site:
    """A gateway with TLS listeners, and clients with certificates."""

    def __init__(self, running: Running, pki: Pki, by_unit: int, by_address: int) -> None:
        self.running = running
        self.by_unit, self.by_address = by_unit, by_address
        self._pki = pki

    @contextmanager
    def client(self, certificate: str, port: int) -> Iterator[ModbusTlsClient]:
        """A client of pymodbus' own that shows this certificate."""
        context = self._pki.client(certificate)
        context.check_hostname = False  # pymodbus' synchronous client does not say whom it wants
        client = ModbusTlsClient("localhost", port=port, sslctx=context, timeout=60, retries=0)
        assert client.connect()  # type: ignore[no-untyped-call]
        try:
            yield client
        finally:
            client.close()  # type: ignore[no-untyped-call]


@pytest.fixture
def site(launch: Launch, tmp_path: Path, free_tcp_port: Callable[[], int], peer: Callable[[str], str]) -> Site:
    peer("openssl")
    pki = Pki.of_the_recipe(tmp_path / "pki")
    (pki.folder / "server.key").chmod(0o600)
    ports = free_tcp_port(), free_tcp_port()
    tls = TLS.format(folder=pki.folder, by_unit=ports[0], by_address=ports[1])
    running = launch(
        simulate=("--line", "shelter-a=1"),
        devices=(("shelter-a", "array-1", 1, 11),),
        rest=tls,
        modbus_keys="writes = true",
    )
    running.wait_online()
    return Site(running, pki, *ports)


def word(client: ModbusTlsClient, unit: int) -> int:
    reply = client.read_holding_registers(ABSORPTION, count=1, device_id=unit)
    assert not reply.isError()
    (value,) = reply.registers
    return int(value)


def test_a_role_writes_and_the_ledger_names_it(site: Site) -> None:
    with site.client("reader", site.by_unit) as reader:
        before = word(reader, 11)
        assert before != VALUE
        assert reader.write_register(ABSORPTION, VALUE, device_id=11).exception_code == 1
    with site.client("norole", site.by_unit) as nobody:
        assert nobody.read_holding_registers(ABSORPTION, count=1, device_id=11).exception_code == 1
    with site.client("operator", site.by_address) as operator:
        assert word(operator, 1) == before
        assert not operator.write_register(ABSORPTION, VALUE, device_id=1).isError()
        assert operator.write_register(ABSORPTION + 1, VALUE, device_id=1).exception_code == 1
    with site.client("operator", site.by_unit) as operator:
        assert word(operator, 11) == VALUE

    running = site.running
    (entry,) = entries(read_ledger(running.folder / "state"))
    assert (entry.intent.role, entry.intent.point, entry.intent.old, entry.intent.new) == (
        "operator",
        "absorption_voltage",
        before,
        VALUE,
    )
    assert entry.verdict is not None
    assert entry.verdict.fate is Fate.WRITTEN
    assert '"role":"operator"' in (running.folder / "state" / "writes.jsonl").read_text().replace(" ", "")
    printed = subprocess.run(
        [*GATEWAY, "writes", "-c", str(running.folder / "site.toml")],
        capture_output=True,
        text=True,
        check=True,
        env={**environment(), "COLUMNS": "200"},
    ).stdout
    assert re.search(r"127\.0\.0\.1\W+operator", printed)
    metrics = running.get("/metrics")[1]
    assert 'prostar_gateway_modbus_writes_total{outcome="written"} 1.0' in metrics
    assert 'prostar_gateway_modbus_requests_refused_total{reason="write_not_allowed"}' in metrics

    assert running.gateway.end() == 0
    log = running.gateway.log()
    assert re.search(r"event=write peer=127\.0\.0\.1 role=\S*operator\S* .*point=absorption_voltage", log)
    assert re.search(r"event=write_refused peer=127\.0\.0\.1 role=\S*reader\S* ", log)
    once = Counter(re.findall(r'event=(?:listening|advice) (?:listener|text)="([^"]*)"', log))
    assert sum("127.0.0.1" in what for what in once) == 5, "Modbus, twice through TLS, SNMP, HTTP"
    assert set(once.values()) == {1}, "each is said once"
