"""The gateway put together: what the configuration says reaches every part, and it starts and stops on any loop."""

from __future__ import annotations

import asyncio
import socket
import sys
from ipaddress import ip_network
from pathlib import Path
from typing import cast

import pytest

from gateway.clock import SystemClock
from gateway.core.budget import WATCH_S
from gateway.core.identity import Identity
from gateway.core.settings import UpstreamSettings
from gateway.faces.snmp.settings import Emc1Device
from gateway.service.config import Config, parse_config
from gateway.service.crosscheck import UPSTREAM_KEYS
from gateway.service.gateway import Gateway
from gateway.service.loops import Loop, loop_factory
from gateway.service.schema import LineTable, PollTable
from gateway.service.settings import (
    history_settings,
    http_settings,
    line_budgets,
    line_devices,
    line_settings,
    modbus_settings,
)
from gateway.service.snmp import snmp_settings
from tests.faces.http.test_access import certificate, written
from tests.optional import optional

TEXT = """
site = "ridge-07"
[[line]]
name = "shelter-a"
port = "/nonexistent/a"
baudrate = 19200
parity = "E"
stopbits = 1
reply_timeout_s = 0.25
retries = 1
quarantine_s = 0.2
gap_s = 0.05
queue_limit = 9
queue_limit_s = 1.5
[[line.device]]
name = "array-2"
address = 2
unit_id = 12
model = "prostar-mppt"
decode = { charge_energy_total = "f16" }
product = "PS-MPPT-25M"
serial_number = "17410042"
[[line.device]]
name = "array-1"
address = 1
unit_id = 11
model = "prostar-mppt"
[[line]]
name = "shelter-b"
port = "socket://192.0.2.1:4001"
[[line.device]]
name = "array-3"
address = 1
unit_id = 3
model = "prostar-mppt"
[poll]
live_s = 2.0
settings_s = 60.0
night_s = 6.0
[cache]
max_age_s = 7.0
[modbus]
listen = ["127.0.0.1:0", "[::1]:0"]
max_connections = 3
allow = ["10.1.2.0/24", "10.9.9.9"]
strict_map = true
status_unit = true
[snmp]
listen = ["127.0.0.1:0"]
enterprise_root = "1.3.6.1.4.1.12345.7"
contact = "noc@example.net"
location = "Ridge"
[[snmp.community]]
name = "s3cret"
source = ["10.0.0.0/8"]
[http]
listen = ["127.0.0.1:0"]
"""


@pytest.fixture
def config() -> Config:
    return parse_config(TEXT)


def test_every_key_of_a_line_reaches_its_settings(config: Config) -> None:
    first, second = line_settings(config)
    table = config.line[0]
    for key in LineTable.model_fields.keys() - {"device", "site", *UPSTREAM_KEYS}:
        assert getattr(first, key) == getattr(table, key), key
        if key not in {"name", "port", "bytesize"}:
            assert getattr(first, key) != getattr(second, key), key  # the test's values are not the defaults
    assert (first.index, second.index) == (1, 2)
    for settings in (first, second):
        assert all(getattr(settings.poll, key) == getattr(config.poll, key) for key in PollTable.model_fields)


def test_every_key_of_an_upstream_reaches_its_settings() -> None:
    upstream = """
[[line]]
name = "ridge-08"
port = "tcp://[2001:db8::8]:1502"
site = "ridge-08"
pipelining = 3
connections = 4
connect_timeout_s = 7.5
[[line.device]]
name = "far"
address = 11
unit_id = 99
model = "prostar-mppt"
"""
    config = parse_config(TEXT.replace("[modbus]", f"{upstream}\n[modbus]", 1))
    settings = line_settings(config)
    assert settings[2].upstream == UpstreamSettings(
        "2001:db8::8", 1502, pipelining=3, connections=4, connect_timeout_s=7.5
    )
    assert [line.upstream for line in settings[:2]] == [None, None]
    site = Gateway(config, SystemClock()).site
    assert [site.of_line(line.name) for line in site.lines] == ["ridge-07", "ridge-07", "ridge-08"]


def test_devices_know_their_map_and_reading(config: Config) -> None:
    second, first = line_devices(config.line[0])
    assert (second.name, second.address, second.unit_id, second.decode) == (
        "array-2",
        2,
        12,
        {"charge_energy_total": "f16"},
    )
    assert second.expected == Identity(product="PS-MPPT-25M", serial_number="17410042")
    assert first.decode == {}
    assert first.expected == Identity()
    assert first.map.model == "prostar-mppt"


def test_the_faces_get_their_settings(config: Config) -> None:
    modbus = modbus_settings(config)
    assert modbus.listen == (("127.0.0.1", 0), ("::1", 0))
    assert modbus.allow == (ip_network("10.1.2.0/24"), ip_network("10.9.9.9/32"))
    assert (modbus.max_connections, modbus.max_age_s, modbus.strict_map) == (3, 7.0, True)
    assert modbus.status_unit
    snmp = snmp_settings(config)
    assert snmp.listen == (("127.0.0.1", 0),)
    assert [(entry.name, entry.sources) for entry in snmp.communities] == [("s3cret", (ip_network("10.0.0.0/8"),))]
    assert "s3cret" not in repr(snmp)
    assert snmp.enterprise_root == (1, 3, 6, 1, 4, 1, 12345, 7)
    assert (snmp.contact, snmp.location) == ("noc@example.net", "Ridge")
    assert http_settings(config).listen == (("127.0.0.1", 0),)


def test_the_history_gets_its_settings() -> None:
    text = f'state_dir = "/srv/gateway"\n{TEXT}[history]\ninterval_h = 6.0\n'
    settings = history_settings(parse_config(text))
    assert (settings.directory, settings.interval_s) == (Path("/srv/gateway"), 21600)

    def keepers(text: str) -> list[str]:
        return [keeper.name for keeper in Gateway(parse_config(text), SystemClock()).keepers]

    assert keepers(text) == ["conditions", "history", "log table", "trace"]
    assert keepers(text.replace("[snmp]\n", "[snmp]\nlog_table = false\n")) == ["conditions", "history", "trace"]
    off = text.replace("interval_h = 6.0", "enabled = false")
    assert keepers(off) == ["conditions", "trace"]


def test_the_face_gives_up_before_the_supervisor_does(config: Config) -> None:
    from gateway.service.supervisor import STOP_LISTENERS_S

    assert modbus_settings(config).stop_grace_s < STOP_LISTENERS_S
    assert http_settings(config).stop_grace_s < STOP_LISTENERS_S


def test_without_a_community_no_snmp_port_is_opened() -> None:
    config = parse_config(TEXT.partition("[[snmp.community]]")[0])
    assert snmp_settings(config).listen == ()
    gateway = Gateway(config, SystemClock())
    assert [listener.label.split()[0] for listener in gateway.listeners] == ["modbus", "modbus", "http"]


def test_the_config_never_shows_a_community(config: Config) -> None:
    assert "s3cret" not in repr(config)
    assert "s3cret" not in str(config)


def test_a_site_has_its_devices_by_unit_id_and_line(config: Config) -> None:
    gateway = Gateway(config, SystemClock())
    assert [device.unit_id for device in gateway.site.devices] == [3, 11, 12]
    assert [device.line.name for device in gateway.site.devices] == ["shelter-b", "shelter-a", "shelter-a"]
    assert gateway.not_ready() == (
        "modbus 127.0.0.1:0 is not open",
        "modbus [::1]:0 is not open",
        "snmp 127.0.0.1:0 is not open",
        "http 127.0.0.1:0 is not open",
    )


def test_a_line_with_more_devices_is_used_more(config: Config) -> None:
    first, second = line_budgets(config)
    assert second.use_ratio is not None
    assert first.use_ratio is not None
    assert 0 < second.use_ratio < first.use_ratio < 1
    assert first.reply_deadline_s < second.reply_deadline_s  # shorter queue and time-out, one retry less
    assert modbus_settings(config).reply_timeout_s == second.reply_deadline_s - WATCH_S


async def lifetime(config: Config) -> None:
    gateway = Gateway(config, SystemClock())
    stop = asyncio.Event()
    running = asyncio.create_task(gateway.run(stop))
    try:
        async with asyncio.timeout(30):
            while gateway.not_ready():  # noqa: ASYNC110  # asked as /readyz asks: there is no event
                await asyncio.sleep(0.01)
        _, port = next(listener.bound for listener in gateway.listeners if listener.bound is not None)
        _, writer = await asyncio.open_connection("127.0.0.1", port)
        writer.close()
        await writer.wait_closed()
    finally:
        stop.set()
        await running
    assert all(listener.bound is None for listener in gateway.listeners)


@pytest.mark.parametrize("choice", [Loop.ASYNCIO, Loop.UVLOOP, Loop.AUTO])
def test_it_starts_and_stops_on_either_loop(choice: Loop, tmp_path: Path) -> None:
    if choice is Loop.UVLOOP:
        optional("uvloop")
    text = TEXT.replace(', "[::1]:0"', "").replace("socket://192.0.2.1:4001", "/nonexistent/b")
    config = parse_config(f'state_dir = "{tmp_path}"\n{text}')
    with asyncio.Runner(loop_factory=loop_factory(choice)) as runner:
        runner.run(lifetime(config))


@pytest.mark.parametrize(
    ("choice", "expected"),
    [(Loop.AUTO, "asyncio"), (Loop.ASYNCIO, "asyncio"), (Loop.UVLOOP, None)],
)
def test_without_uvloop_it_runs_unless_asked_for(
    monkeypatch: pytest.MonkeyPatch, choice: Loop, expected: str | None
) -> None:
    monkeypatch.setitem(sys.modules, "uvloop", None)
    if expected is None:
        with pytest.raises(ValueError, match="uvloop is not installed"):
            loop_factory(choice)
    else:
        assert loop_factory(choice) is asyncio.new_event_loop


def test_an_emc1_view_has_a_port_of_its_own_where_somebody_may_read() -> None:
    view = '[[snmp.emc1]]\nunit_id = 12\nlisten = ["127.0.0.1:0", "[::1]:0"]\n'
    config = parse_config(TEXT + view)
    assert snmp_settings(config).emc1 == (Emc1Device(12, (("127.0.0.1", 0), ("::1", 0))),)
    labels = [listener.label for listener in Gateway(config, SystemClock()).listeners]
    assert [label for label in labels if label.startswith("snmp")] == [
        "snmp 127.0.0.1:0",
        "snmp for unit 12 127.0.0.1:0",
        "snmp for unit 12 [::1]:0",
    ]
    nobody = parse_config(TEXT.partition("[[snmp.community]]")[0] + view)
    assert snmp_settings(nobody).emc1 == (Emc1Device(12),)


class Flood:
    """A UDP socket in which there is always one more datagram."""

    def __init__(self) -> None:
        self.sent = 0

    def recvfrom(self, _size: int) -> tuple[bytes, tuple[str, int]]:
        return b"\x30\x00", ("192.0.2.1", 161)

    def sendto(self, _data: bytes, _address: object) -> None:
        self.sent += 1


async def test_a_modbus_client_is_served_in_the_middle_of_an_snmp_turn() -> None:
    text = TEXT.replace(', "[::1]:0"', "").replace('allow = ["10.1.2.0/24", "10.9.9.9"]', "")
    gateway = Gateway(parse_config(text), SystemClock())
    listener = gateway.listeners[0]
    await listener.start()
    try:
        assert listener.bound is not None
        with socket.create_connection(listener.bound) as client:
            async with asyncio.timeout(10):
                while not gateway._modbus.stats.open_connections:  # noqa: ASYNC110  a counter sets no event
                    await asyncio.sleep(0)
            client.setblocking(False)
            client.sendall(bytes.fromhex("0001 0000 0006 fe 03 0000 0001"))
            gateway._snmp.answer_waiting(cast("socket.socket", Flood()))  # the loop has nothing to say in it
            reply = client.recv(64)
        assert (reply[:4], reply[6]) == (bytes.fromhex("0001 0000"), 0xFE)
    finally:
        await listener.stop()


async def test_a_model_that_is_found_reads_no_file_of_https(tmp_path: Path) -> None:
    """It comes when it comes: perhaps while somebody copies a new certificate, perhaps when no file can be read."""
    crt, key = certificate(tmp_path)
    text = f'tls_certificate = "{crt}"\ntls_private_key = "{key}"\n'
    gateway = Gateway(parse_config(TEXT + text), SystemClock())
    listener = gateway.listeners[-1]
    await listener.start()
    try:
        written(tmp_path, "key", "not yet")
        await gateway.show_models()
        assert listener in gateway.listeners
    finally:
        await listener.stop()
