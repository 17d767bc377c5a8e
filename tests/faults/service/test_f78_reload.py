"""F78: SIGHUP with a bad configuration, and with a good one in which anything is another."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import re
import signal
import ssl
import subprocess
import time
import urllib.error
import urllib.request
from collections.abc import AsyncIterator, Callable, Sequence
from pathlib import Path

import pytest

from gateway.devices.schema import load_map
from tests.e2e.programs import alive, environment
from tests.faces.modbus.tls.conftest import pki
from tests.faces.modbus.tls.site import Pki
from tests.faults.service.rig import NotifySocket, Service, client, descriptors, read
from tests.machine import Bystander

__all__ = ["pki"]

LINE_KEYS = "baudrate = 115200\nreply_timeout_s = 0.3"
FAST = "[poll]\nlive_s = 0.2\n"
A1 = ("shelter-a", "array-1", 1, 11)
A2 = ("shelter-a", "array-2", 2, 12)
B3 = ("shelter-b", "array-3", 1, 13)
Devices = Sequence[tuple[str, str, int, int]]


class Reader:
    """A client that reads as fast as it is answered; what came, and how long the longest reply took."""

    def __init__(self) -> None:
        self.replies: set[bytes] = set()
        self.count = 0
        self.worst_s = 0.0
        self.over = False

    async def run(self, port: int, unit: int) -> None:
        """Read until cancelled."""
        async with client(port) as asker:
            while True:
                began = time.monotonic()
                reply = await asker.read(unit)
                self.worst_s = max(self.worst_s, time.monotonic() - began)
                self.replies.add(reply[:2])
                self.count += 1
                await asyncio.sleep(0.002)


@contextlib.asynccontextmanager
async def reading(port: int, unit: int) -> AsyncIterator[Reader]:
    """A client that reads all the while."""
    reader = Reader()
    task = asyncio.create_task(reader.run(port, unit))
    try:
        yield reader
    finally:
        assert not task.done()
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task


async def reload(service: Service) -> str:
    """Have the configuration read again; the line of the log that says what came of it."""
    service.programs[-1].process.send_signal(signal.SIGHUP)
    return await service.log(r"event=reload(ed|_refused) ")


def configure(service: Service, *devices: tuple[str, str, int, int], rest: str = FAST, modbus_keys: str = "") -> None:
    service.configure(devices, rest, LINE_KEYS, modbus_keys)


async def port_of(service: Service, line: str) -> str:
    """Descriptor and inode of a line's open port, so that another opening of it is seen."""
    found = descriptors(service.programs[-1].process.pid)
    return next(fd for fd, target in found.items() if target == service.lines[line].device)


async def test_a_bad_configuration_is_refused_whole_with_every_problem(service: Service, systemd: NotifySocket) -> None:
    configure(service, A1)
    program = service.start(NOTIFY_SOCKET=systemd.path)
    await service.online()
    await systemd.next("READY=1")
    async with reading(service.modbus, 11) as reader:
        text = service.config.read_text().replace("address = 1\n", "address = 300\n")
        service.config.write_text(text.replace("[http]", "[http]\nlisteners = 1") + "[history]\nenabled = false\n")
        before = time.clock_gettime(time.CLOCK_MONOTONIC)
        assert "problems=2 kept=old" in await reload(service)
        assert sum("reload_problem" in line and ".address" in line for line in program.seen) == 1
        assert sum("reload_problem" in line and "http.listeners" in line for line in program.seen) == 1
        moment = re.fullmatch(r"RELOADING=1\nMONOTONIC_USEC=(\d+)", await systemd.next("RELOADING=1"))
        assert moment is not None
        assert before - 0.1 < int(moment[1]) / 1e6 < time.clock_gettime(time.CLOCK_MONOTONIC)
        await systemd.next("READY=1")
        service.config.unlink()
        assert "problems=1 kept=old" in await reload(service)
        metrics = (await service.get("/metrics"))[1]
        assert "prostar_gateway_config_last_reload_successful 0" in metrics
        assert 'prostar_gateway_config_reloads_total{outcome="refused"} 2.0' in metrics
        assert "prostar_gateway_history_store_up" in metrics  # the part of it that was right was not taken either
    assert reader.replies == {b"\x03\x04"}
    assert await service.end() == 0


async def test_what_did_not_change_does_not_notice(service: Service) -> None:
    """The same file again, then one with another line, device, rule, limit and period: the first line goes on."""
    service.plug("shelter-b", 1)
    configure(service, A1)
    service.start()
    await service.online()
    port = await port_of(service, "shelter-a")
    opens = re.compile(r'^prostar_gateway_line_opens_total\{line="shelter-a".*\} (.*)$', re.MULTILINE)
    write = b"\x06" + load_map("prostar-mppt").point("float_voltage").address.to_bytes(2) + b"\x4a\x00"
    async with reading(service.modbus, 11) as reader, client(service.modbus) as other:
        assert 'changed=""' in await reload(service)
        other.ask(11, write)
        assert await other.reply() == b"\x86\x01"
        rule = '[[modbus.write]]\nsource = ["127.0.0.1"]\npoint = ["float_voltage"]\n'
        rest = f"[poll]\nlive_s = 0.3\n{rule}[modbus.rate]\nburst_s = 3.0\n"
        configure(service, A1, B3, rest=rest, modbus_keys="max_connections = 9\nwrites = true")
        said = await reload(service)
        for key in ("line[shelter-b]", "poll.live_s", "modbus.max_connections", "modbus.rate.burst_s", "modbus.write"):
            assert key in said
        await service.online("array-1", "array-3")
        assert (await other.read(13))[:2] == b"\x03\x04"
        other.ask(11, write)
        assert (await other.reply())[:2] != b"\x86\x01"
        assert write in service.units["shelter-a"][0].asked
        configure(service, A1)
        await reload(service)
        assert await other.read(13) == b"\x83\x0a"
        other.ask(11, write)
        assert await other.reply() == b"\x86\x01"
        for _ in range(5):
            await reload(service)
    assert reader.replies == {b"\x03\x04"}
    assert reader.count > 20
    assert reader.worst_s < 10.0
    assert await port_of(service, "shelter-a") == port
    assert opens.findall((await service.get("/metrics"))[1]) == ["1.0"]
    assert await service.end() == 0


class Watcher:
    """A client that notes whose words it is given, and which configurations may have been in use meanwhile."""

    def __init__(self, unit_id: int) -> None:
        self.unit_id = unit_id
        self.steps = 0  # even: the configuration of this half is in use; odd: the next one is coming
        self.given: list[tuple[range, bytes]] = []

    async def run(self, port: int) -> None:
        """Read until cancelled."""
        async with client(port) as asker:
            while True:
                asked = self.steps
                reply = await asker.read(self.unit_id)
                assert reply, "every request is answered"
                if reply[0] < 0x80:
                    self.given.append((range(asked // 2, (self.steps + 1) // 2 + 1), reply[2:]))
                await asyncio.sleep(0.002)


async def test_unit_ids_that_are_swapped_are_never_mixed(service: Service) -> None:
    """And the lines with them, so that each has another index: not one request is answered by the other controller."""
    service.plug("shelter-b", 1)
    sites: list[Devices] = [(A1, B3), ((*B3[:3], 11), (*A1[:3], 13)), ((*A1[:3], 13), (*B3[:3], 11)), (B3,)]
    units = {line: found[0] for line, found in service.units.items()}
    words = {line: unit.word(0x12).to_bytes(2) + unit.word(0x13).to_bytes(2) for line, unit in units.items()}
    wanted = [{unit_id: words[line] for line, _, _, unit_id in site} for site in sites]
    configure(service, *sites[0])
    service.start()
    await service.online()
    watchers = [Watcher(11), Watcher(13)]
    tasks = [asyncio.create_task(watcher.run(service.modbus)) for watcher in watchers]
    for number, site in enumerate(sites[1:], 1):
        configure(service, *site)
        for watcher in watchers:
            watcher.steps += 1
        assert "event=reloaded" in await reload(service)
        for watcher in watchers:
            watcher.steps += 1
        await service.online()
        async with client(service.modbus) as asker:
            for unit_id, expected in wanted[number].items():
                assert await asker.read(unit_id) == b"\x03\x04" + expected
        text = (await service.get("/metrics"))[1]
        shown = re.findall(r'^morningstar_up\{device="(.*?)",line="(.*?)",.*unit_id="(\d+)"\} 1.0$', text, re.MULTILINE)
        assert sorted(shown) == sorted((name, line, str(unit_id)) for line, name, _, unit_id in site)
        lines = list(dict.fromkeys(line for line, *_ in site))
        conditions = json.loads((await service.get("/api/v1/conditions?state=all"))[1])["conditions"]
        assert [each["line"] for each in conditions if each["condition"] == "line_down"] == lines
    for watcher, task in zip(watchers, tasks, strict=True):
        assert not task.done()
        task.cancel()
        for configurations, given in watcher.given:
            assert any(wanted[number].get(watcher.unit_id) == given for number in configurations)
    await asyncio.gather(*tasks, return_exceptions=True)
    assert len(watchers[0].given) > 20
    assert await service.end() == 0
    assert "task_failed" not in service.programs[-1].log() + "".join(service.programs[-1].seen)


async def test_another_port_another_address_another_device(service: Service) -> None:
    service.plug("shelter-b", 1)
    configure(service, A1, B3)
    service.start()
    await service.online()
    async with reading(service.modbus, 11) as reader, client(service.modbus) as other:
        service.lines["shelter-b"].unplug()
        await service.log("line_down line=shelter-b")
        service.plug("elsewhere", 1)
        text = service.config.read_text()
        service.config.write_text(
            text.replace(f'port = "{service.folder}/shelter-b"', f'port = "{service.folder}/elsewhere"')
        )
        assert "line[shelter-b].port" in await reload(service)
        await service.online()
        assert (await other.read(13))[:2] == b"\x03\x04"
        configure(service, A1, A2)  # a device more on the first line: that line is opened anew, and soon serves both
        assert "line[shelter-b]" in await reload(service)
        await service.online("array-1", "array-2")
        assert (await other.read(12))[:2] == b"\x03\x04"
        assert await other.read(13) == b"\x83\x0a"
        assert 'device="array-3"' not in (await service.get("/metrics"))[1]
    assert reader.replies <= {b"\x03\x04", b"\x83\x0a", b"\x83\x06", b"\x83\x0b"}
    assert await service.end() == 0


async def test_listeners_come_and_go_and_strangers_are_cut_off(
    service: Service, free_tcp_port: Callable[[], int]
) -> None:
    configure(service, A1)
    service.start()
    await service.online()
    new = free_tcp_port()
    text = service.config.read_text()
    async with reading(service.modbus, 11) as reader:
        service.config.write_text(
            text.replace(f'"127.0.0.1:{service.modbus}"', f'"127.0.0.1:{service.modbus}", "127.0.0.1:{new}"')
        )
        await reload(service)
        async with client(new) as guest:
            assert (await guest.read(11))[:2] == b"\x03\x04"
            service.config.write_text(text)
            await reload(service)
            assert await guest.reply() == b""
        with pytest.raises(OSError):
            await asyncio.open_connection("127.0.0.1", new)
    assert reader.replies == {b"\x03\x04"}
    async with client(service.modbus) as guest:
        assert (await guest.read(11))[:2] == b"\x03\x04"
        service.config.write_text(text.replace("[http]", 'allow = ["127.0.0.9"]\n[http]'))
        await reload(service)
        assert await guest.reply() == b""
    async with client(service.modbus) as stranger:
        assert await stranger.read(11) == b""
    service.config.write_text(text)
    await reload(service)
    async with client(service.modbus) as guest:
        assert (await guest.read(11))[:2] == b"\x03\x04"
    assert await service.end() == 0


def snmp_get(program: str, service: Service, *credentials: str) -> str:
    """sysName, or what net-snmp says instead."""
    asked = [program, *credentials, "-r0", "-t2", "-Oqv", f"127.0.0.1:{service.snmp}", "1.3.6.1.2.1.1.5.0"]
    done = subprocess.run(asked, capture_output=True, text=True, env=environment(), check=False)
    return done.stdout.strip().strip('"') or done.stderr.strip()


def user(name: str, folder: Path, password: str) -> tuple[str, tuple[str, ...]]:
    """A user of SNMPv3 in the configuration, and for net-snmp; the pass phrase is in a file."""
    path = folder / f"{name}.secret"
    path.write_text(password)
    table = f'[[snmp.user]]\nname = "{name}"\nauth_password_file = "{path}"\npriv_password_file = "{path}"\n'
    shown = ("-v3", "-l", "authPriv", "-u", name, "-a", "SHA-256", "-A", password, "-x", "AES", "-X", password)
    return table, shown


@pytest.mark.peer
async def test_snmp_keeps_its_engine_and_learns_users_secrets_and_communities(
    service: Service, peer: Callable[[str], str], tmp_path: Path
) -> None:
    snmpget = peer("snmpget")
    table, noc = user("noc", tmp_path, "correct-horse-1")
    configure(service, A1, rest=FAST + table)
    service.start()
    await service.online()
    assert snmp_get(snmpget, service, *noc) == "ridge-07"
    engine = await engine_of(snmpget, service, noc)
    # An open session goes on: the engine, its boots and its time are the same.
    second, admin = user("admin", tmp_path, "correct-horse-2")
    configure(service, A1, rest=FAST + table + second + '[[snmp.community]]\nname = "other"\nsource = ["127.0.0.1"]\n')
    await reload(service)
    for credentials in (noc, admin, ("-v2c", "-c", "other"), ("-v2c", "-c", "public")):
        assert snmp_get(snmpget, service, *credentials) == "ridge-07"
    assert await engine_of(snmpget, service, noc) == engine
    _, changed = user("noc", tmp_path, "correct-horse-3")  # another secret in the same file
    configure(service, A1, rest=FAST + table)
    await reload(service)
    assert snmp_get(snmpget, service, *changed) == "ridge-07"
    for credentials in (noc, admin, ("-v2c", "-c", "other")):
        assert "ridge-07" not in snmp_get(snmpget, service, *credentials)
    (tmp_path / "noc.secret").write_text("short")
    assert "refused" in await reload(service)
    assert snmp_get(snmpget, service, *changed) == "ridge-07"
    (tmp_path / "noc.secret").unlink()
    assert "refused" in await reload(service)
    assert snmp_get(snmpget, service, *changed) == "ridge-07"
    assert await service.end() == 0
    log = service.programs[-1].log() + "\n".join(service.programs[-1].seen)
    assert "correct-horse" not in log


async def engine_of(snmpget: str, service: Service, credentials: tuple[str, ...]) -> list[str]:
    """Engine id and boots."""
    asked = [
        snmpget,
        *credentials,
        "-Oqv",
        f"127.0.0.1:{service.snmp}",
        "1.3.6.1.6.3.10.2.1.1.0",
        "1.3.6.1.6.3.10.2.1.2.0",
    ]
    done = await asyncio.to_thread(
        subprocess.run, asked, capture_output=True, text=True, env=environment(), check=False
    )
    return [*done.stdout.split("\n"), (service.folder / "state" / "snmp-engine").read_text()]


async def test_the_secrets_and_the_certificate_of_http_are_read_again(service: Service, pki: Pki) -> None:
    files, token = pki.files(), service.folder / "token"
    certificate, key = service.folder / "http.pem", service.folder / "http.key"

    def put(name: str) -> None:
        certificate.write_bytes((pki.folder / f"{name}.pem").read_bytes())
        key.write_bytes((pki.folder / f"{name}.key").read_bytes())

    certificate.write_bytes(files.certificate.read_bytes())
    key.write_bytes(files.key.read_bytes())
    token.write_text("0123456789abcdef")
    service.configure((A1,), FAST, LINE_KEYS)
    keys = f'bearer_token_file = "{token}"\ntls_certificate = "{certificate}"\ntls_private_key = "{key}"\n'
    service.config.write_text(service.config.read_text().replace("[snmp]", f"{keys}[snmp]"))
    service.start()
    await service.log("event=listening listener=.http")
    assert await fetch(service, "0123456789abcdef") == 200
    first = await certificate_of(service)
    token.write_text("fedcba9876543210")
    assert "changed" in await reload(service)
    assert await fetch(service, "0123456789abcdef") == 401
    assert await fetch(service, "fedcba9876543210") == 200
    assert await certificate_of(service) == first
    issue(certificate, key)
    await reload(service)
    assert await certificate_of(service) != first
    token.write_text("short")
    key.write_text("no key")
    assert "refused" in await reload(service)
    assert await fetch(service, "fedcba9876543210") == 200
    assert await certificate_of(service) != first
    assert await service.end() == 0


def issue(certificate: Path, key: Path) -> None:
    """A new certificate of its own."""
    subprocess.run(
        ["openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes", "-days", "2",
         "-subj", "/CN=new", "-keyout", str(key), "-out", str(certificate)],
        check=True, capture_output=True,
    )  # fmt: skip


async def certificate_of(service: Service) -> str:
    """What the HTTP face shows now."""
    return await asyncio.to_thread(ssl.get_server_certificate, ("127.0.0.1", service.http))


async def fetch(service: Service, token: str) -> int:
    """The status of a scrape with this token."""
    context = ssl._create_unverified_context()

    def ask() -> int:
        request = urllib.request.Request(
            f"https://127.0.0.1:{service.http}/metrics", headers={"Authorization": f"Bearer {token}"}
        )
        try:
            with urllib.request.urlopen(request, timeout=60, context=context) as reply:
                return int(reply.status)
        except urllib.error.HTTPError as error:
            with error:
                return error.code

    return await asyncio.to_thread(ask)


async def test_what_only_a_restart_can_change_is_said_and_kept(service: Service) -> None:
    configure(service, A1)
    program = service.start()
    await service.online()
    text = service.config.read_text()
    service.config.write_text(text.replace("/state", "/elsewhere"))
    assert 'changed=""' in await reload(service)
    assert any("event=reload_needs_restart key=state_dir" in line for line in program.seen)
    assert not (service.folder / "elsewhere").exists()
    assert await service.end() == 0


async def test_a_stop_does_not_wait_for_a_file_that_does_not_come(
    service: Service, tmp_path: Path, passing: Bystander
) -> None:
    """As on a network file system whose server is gone: who opens the file waits, here a thread of the gateway itself.

    The process that reads the configuration: tests/faults/service/test_f72_stopping.py.
    """
    table, _ = user("noc", tmp_path, "correct-horse-1")
    configure(service, A1, rest=FAST + table)
    program = service.start()
    await service.online()
    secret, pid = tmp_path / "noc.secret", program.process.pid
    secret.unlink()
    os.mkfifo(secret)
    program.process.send_signal(signal.SIGHUP)
    async with asyncio.timeout(30):
        while not opens_a_pipe(pid):
            if any(map(opens_a_pipe, children_of_all(pid))):
                await asyncio.to_thread(secret.write_text, "correct-horse-1")
            await asyncio.sleep(0.01)
    passing.start()
    program.process.terminate()
    assert await service.ended() == 0
    assert passing.stop() < 10.0  # F72
    assert program.log().endswith("event=stopped status=0")


def children_of_all(pid: int) -> list[int]:
    """What any thread of the process has started, and is not over."""
    found = []
    for task in Path(f"/proc/{pid}/task").iterdir():
        found += [int(child) for child in (task / "children").read_text().split()]
    return alive(found)


def opens_a_pipe(pid: int) -> bool:
    """Whether a thread of the process waits for somebody who writes into what it wants to read."""
    return any((task / "wchan").read_text() == "wait_for_partner" for task in Path(f"/proc/{pid}/task").iterdir())


async def test_stopping_in_the_middle_of_a_reload(service: Service) -> None:
    service.plug("shelter-b", 1)
    configure(service, A1, B3)
    program = service.start()
    await service.online()
    configure(service, A1, A2)
    program.process.send_signal(signal.SIGHUP)
    os.sched_yield()
    assert await service.end() == 0
    assert "Traceback" not in program.log()


async def test_stopping_while_a_line_that_goes_has_a_request_on_the_wire(service: Service) -> None:
    """The reload waits for the line, and the stop for both: who asked is answered, and the log ends as it should."""
    service.plug("shelter-b", 1)
    service.configure((A1, B3), line_keys="baudrate = 115200\nreply_timeout_s = 2.0\nretries = 0")
    program = service.start()
    await service.online()
    (unit,) = service.units["shelter-b"]
    await unit.is_quiet()
    unit.never_answered = read()
    async with client(service.modbus) as asker:
        asker.ask(13, read())
        await unit.is_asked(read())
        service.configure((A1,))
        program.process.send_signal(signal.SIGHUP)
        while 'device="array-3"' in (await service.get("/metrics"))[1]:  # noqa: ASYNC110 - another process
            await asyncio.sleep(0.01)
        assert await service.end() == 0
        assert await asker.reply() in {b"\x83\x06", b"\x83\x0b"}
    log = program.log()
    assert log.endswith("event=stopped status=0")
    assert "event=reload_refused" not in log
    assert "Traceback" not in log
