"""F79: addresses that cannot be listened on: which listener, why, and everything else goes on."""

from __future__ import annotations

import asyncio
import os
import re
import shutil
import socket
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.e2e.programs import GATEWAY, Program, environment
from tests.faults.service.rig import QUIET, Service, client

CAN_ANYBODY = Path("/proc/sys/net/ipv4/ip_unprivileged_port_start")
SNMP_PORT, MODBUS_PORT, HTTP_PORT = 161, 502, 80


def unprivileged() -> list[str]:
    """How a program is run that may not open ports below 1024, whoever runs the tests."""
    if int(CAN_ANYBODY.read_text()) <= MODBUS_PORT:
        pytest.skip("anybody may open low ports here")
    if os.geteuid() != 0:
        return []
    setpriv = shutil.which("setpriv", path="/usr/bin:/bin")
    assert setpriv is not None
    return [setpriv, "--bounding-set", "-net_bind_service", "--inh-caps", "-net_bind_service"]


async def test_without_the_capability_low_ports_are_named_and_the_others_serve(service: Service) -> None:
    service.configure(rest=QUIET)
    text = service.config.read_text()
    for face, port, low in (
        ("modbus", service.modbus, MODBUS_PORT),
        ("snmp", service.snmp, SNMP_PORT),
        ("http", service.http, HTTP_PORT),
    ):
        assert f'[{face}]\nlisten = ["127.0.0.1:{port}"]' in text
        text = text.replace(f'"127.0.0.1:{port}"', f'"127.0.0.1:{port}", "127.0.0.1:{low}"')
    service.config.write_text(text)
    program = Program([*unprivileged(), *GATEWAY, "run", "-c", str(service.config)])
    service.programs.append(program)
    await service.online()
    status = (Path("/proc") / str(program.process.pid) / "status").read_text()
    (effective,) = re.findall(r"^CapEff:\s+([0-9a-f]+)$", status, re.MULTILINE)
    assert not int(effective, 16) >> 10 & 1  # CAP_NET_BIND_SERVICE
    closed = ("modbus 127.0.0.1:502", "snmp 127.0.0.1:161", "http 127.0.0.1:80")
    code, text = await service.get("/readyz")
    assert (code, set(text.splitlines())) == (503, {"not ready", *(f"{label} is not open" for label in closed)})
    async with client(service.modbus) as asker:
        assert (await asker.read(11))[:2] == b"\x03\x04"
    assert await service.end() == 0
    said = [line for line in program.log().splitlines() if "event=listen_failed" in line]
    for label in closed:
        (line,) = (line for line in said if f'listener="{label}"' in line)
        assert "not permitted: a port below 1024 needs CAP_NET_BIND_SERVICE" in line
    assert len(said) == len(closed)  # each once, however often it is tried
    assert "Traceback" not in program.log()


async def test_a_taken_address_is_named_on_every_face_the_others_go_on_and_it_is_tried_again(
    service: Service, free_tcp_port: Callable[[], int]
) -> None:
    taken = free_tcp_port()
    service.configure(rest=QUIET)
    text = service.config.read_text()
    service.config.write_text(
        text.replace(f'"127.0.0.1:{service.http}"', f'"127.0.0.1:{service.http}", "127.0.0.1:{taken}"')
    )
    with (
        socket.create_server(("127.0.0.1", service.modbus)),
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as holder,
        socket.create_server(("127.0.0.1", taken)),
    ):
        holder.bind(("127.0.0.1", service.snmp))
        program = service.start()
        labels = {f"modbus 127.0.0.1:{service.modbus}", f"snmp 127.0.0.1:{service.snmp}", f"http 127.0.0.1:{taken}"}
        said = [await service.log("event=listen_failed") for _ in labels]
        assert all("another program listens there" in line for line in said), said
        assert {found for line in said for found in re.findall(r'listener="(.*?)"', line)} == labels
        await service.online()  # the line is read, and HTTP answers at its other address
        code, body = await service.get("/readyz")
        assert (code, set(body.splitlines())) == (503, {"not ready", *(f"{label} is not open" for label in labels)})
        assert (await service.get("/healthz"))[0] == 200
    for _ in labels:
        await service.log("event=listening .*after_s=")
    assert await service.get("/readyz") == (200, "ready\n")
    async with client(service.modbus) as asker:
        assert (await asker.read(11))[:2] == b"\x03\x04"
    assert await service.end() == 0
    assert program.log().count("event=listen_failed") == len(labels)  # each once, however often it was tried
    assert "Traceback" not in program.log()


@pytest.mark.peer
async def test_a_machine_with_ipv6_only_is_served_on_every_face(service: Service, peer: Callable[[str], str]) -> None:
    snmpget = peer("snmpget")
    with socket.socket(socket.AF_INET6) as probe:
        try:
            probe.bind(("::1", 0))
        except OSError:
            pytest.skip("this machine has no IPv6")
    service.configure(rest=QUIET)
    text = service.config.read_text().replace('"127.0.0.1:', '"[::1]:').replace('["127.0.0.0/8"]', '["::1"]')
    assert text.count('listen = ["[::1]:') == 3
    service.config.write_text(text)
    program = service.start()
    await service.log("event=device_online")
    reader, writer = await asyncio.open_connection("::1", service.modbus)
    writer.write(bytes.fromhex("000700000006 0B 03 0012 0002"))
    assert (await asyncio.wait_for(reader.readexactly(9), 10))[:8] == bytes.fromhex("000700000007 0B 03")
    writer.close()
    asked = [snmpget, "-v2c", "-c", "public", "-Oqv", f"udp6:[::1]:{service.snmp}", "1.3.6.1.2.1.1.5.0"]
    shown = await asyncio.to_thread(
        subprocess.run, asked, capture_output=True, text=True, check=False, env=environment()
    )
    assert "ridge-07" in shown.stdout, shown.stderr
    reader, writer = await asyncio.open_connection("::1", service.http)
    writer.write(b"GET /readyz HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n")
    assert b"200 OK" in await asyncio.wait_for(reader.readline(), 10)
    writer.close()
    assert await service.end() == 0
    assert "Traceback" not in program.log()
    assert "listen_failed" not in program.log()
