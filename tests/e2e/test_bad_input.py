"""What is wrong around the gateway is said, stays where it is, and is over when its cause is."""

from __future__ import annotations

import random
import signal
import socket
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import pytest
import serial

from tests.e2e.programs import (
    DEMO_DEVICES,
    GATEWAY,
    Launch,
    Start,
    environment,
    wait_until,
)

READ_RAM = bytes.fromhex("0000000000060103 0012 0005".replace(" ", ""))
"""An MBAP request for unit 1: five registers from 0x0012; the unit is replaced."""


def ask(port: int, unit: int, *, tid: int = 7) -> bytes:
    """The reply PDU to a read of five live registers."""
    request = tid.to_bytes(2) + READ_RAM[2:6] + bytes([unit]) + READ_RAM[7:]
    with socket.create_connection(("127.0.0.1", port), timeout=30) as client, client.makefile("rb") as stream:
        client.sendall(request)
        header = stream.read(7)
        assert header[:2] == tid.to_bytes(2)
        assert header[6] == unit
        return stream.read(int.from_bytes(header[4:6]) - 1)


def test_a_bad_config_exits_78_with_every_problem(tmp_path: Path) -> None:
    path = tmp_path / "site.toml"
    path.write_text('sight = "a"\n[[line]]\nname = "a"\n[poll]\nlive_s = 0\n[modbus]\nwrites = 1\n')
    for command in ("run", "check-config"):
        done = subprocess.run([*GATEWAY, command, "-c", str(path)], capture_output=True, text=True, check=False)
        assert done.returncode == 78
        assert done.stdout == ""
        *problems, last = done.stderr.splitlines()
        assert [line.removeprefix(f"{path}: ").split(": ")[0] for line in problems] == [
            "sight",
            "line[0].port",
            "line[0].device",
            "poll.live_s",
            "modbus.writes",
            "site",
        ]
        assert last == f"6 problems in {path}"


def test_an_absent_port_is_named_the_others_go_on_and_it_is_retried(launch: Launch, start: Start) -> None:
    site = launch(simulate=["--line", "shelter-b=1"])
    line = site.gateway.wait_for(r"line_down line=shelter-a")
    assert str(site.folder / "shelter-a") in line
    assert "no such device" in line
    site.wait_online("array-3")
    assert ask(site.modbus, 13)[0] == 0x03
    assert ask(site.modbus, 11) == b"\x83\x0a"  # no path: the line is not open
    assert site.get("/readyz") == (200, "ready\n")  # a missing line is not about readiness
    start(*GATEWAY, "simulate", "--link-dir", str(site.folder), "--line", "shelter-a=1,2")
    site.gateway.wait_for(r"line_up line=shelter-a")
    site.wait_online()
    assert site.gateway.end() == 0


def test_a_busy_port_is_named_with_its_holder(launch: Launch, start: Start, tmp_path: Path) -> None:
    start(*GATEWAY, "simulate", "--link-dir", str(tmp_path))
    wait_until((tmp_path / "shelter-a").exists, "the simulated line")
    with serial.Serial(str(tmp_path / "shelter-a"), exclusive=True):
        site = launch(simulate=None)
        assert "in use by" in site.gateway.wait_for(r"line_down line=shelter-a")
        site.wait_online("array-3")
    site.wait_online()


def test_a_silent_device_is_offline_and_the_others_are_served(launch: Launch) -> None:
    # Nobody has address 9: what is asked of it is never answered.
    site = launch(devices=(*DEMO_DEVICES, ("shelter-a", "ghost", 9, 19)))
    site.gateway.wait_for(r"device_offline .*device=ghost")
    site.wait_online("array-1", "array-2", "array-3")
    took_s = []
    for _ in range(5):
        began = time.monotonic()
        assert ask(site.modbus, 19) == b"\x83\x0b"
        took_s.append(time.monotonic() - began)
    assert min(took_s) < 0.5  # refused at once, without waiting for the line
    for unit in (11, 12, 13):
        assert ask(site.modbus, unit)[0] == 0x03
    metrics = site.get("/metrics")[1]
    assert 'morningstar_battery_voltage_volts{device="array-1"' in metrics
    assert 'morningstar_battery_voltage_volts{device="ghost"' not in metrics
    assert site.up() == {"array-1": 1, "array-2": 1, "array-3": 1, "ghost": 0}


@pytest.mark.peer
def test_malformed_frames_stop_nothing(launch: Launch, peer: Callable[[str], str]) -> None:
    site = launch()
    site.wait_online()
    # repeatable, so that a failure can be looked at again
    source = random.Random(20261122)
    right = (7).to_bytes(2) + READ_RAM[2:6] + bytes([11]) + READ_RAM[7:]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for _ in range(300):
            noise = source.randbytes(source.randrange(1, 300))
            sender.sendto(noise, ("127.0.0.1", site.snmp))
            sender.sendto(b"\x30\x82" + noise, ("127.0.0.1", site.snmp))
    for _ in range(60):
        mutated = bytearray(right * source.randrange(1, 4))
        for _ in range(source.randrange(1, 5)):
            mutated[source.randrange(len(mutated))] = source.randrange(256)
        with socket.create_connection(("127.0.0.1", site.modbus), timeout=60) as client:
            client.sendall(source.choice([bytes(mutated), source.randbytes(source.randrange(1, 300))]))
            client.shutdown(socket.SHUT_WR)
    assert ask(site.modbus, 11)[0] == 0x03
    asked = [peer("snmpget"), "-v2c", "-c", "public", "-Oqv", f"127.0.0.1:{site.snmp}", "1.3.6.1.2.1.1.1.0"]
    shown = subprocess.run(asked, capture_output=True, text=True, env=environment(), check=False)
    assert "prostar-gateway" in shown.stdout
    assert "task_failed" not in site.gateway.log()
    assert "Traceback" not in site.gateway.log()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_stops_it_with_exit_status_0(launch: Launch, start: Start, number: signal.Signals) -> None:
    site = launch()
    took_s: list[float] = []
    while not took_s or (took_s[-1] >= 2.0 and len(took_s) < 4):  # of a busy machine its best
        if took_s:
            site.gateway = start(*GATEWAY, "run", "-c", str(site.folder / "site.toml"))
        site.wait_online("array-1")
        with socket.create_connection(("127.0.0.1", site.modbus), timeout=30):  # an idle client is no reason to wait
            began = time.monotonic()
            assert site.gateway.end(number) == 0
            took_s.append(time.monotonic() - began)
        log = site.gateway.log()
        assert f"event=stopping signal={number.name}" in log
        assert log.endswith("event=stopped status=0")
        assert "Traceback" not in log
    assert min(took_s) < 2.0
