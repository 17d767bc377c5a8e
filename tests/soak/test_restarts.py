"""F76: started, asked, killed or stopped, two hundred times; every start serves, and state_dir is whole at the end."""

from __future__ import annotations

import os
import re
import signal
import socket
import sqlite3
import struct
import sys
from collections.abc import Callable
from contextlib import closing, suppress
from pathlib import Path

import pytest

from gateway.faces.snmp.engine import FILE_NAME, parse_state
from gateway.history.database import open_for_reading
from tests.e2e.fast_lines import BAUDRATE
from tests.e2e.programs import GATEWAY, Program, Start, wait_until, write_config

READ = struct.pack(">HHHBBHH", 1, 0, 6, 11, 3, 0x10, 2)
SERVES_S = 15.0
USER = '[[snmp.user]]\nname = "noc"\nauth_password_file = "{0}/auth"\npriv_password_file = "{0}/priv"\n'


def good_reply(port: int) -> bool:
    """Whether array-1 is read."""
    with suppress(OSError), socket.create_connection(("127.0.0.1", port), timeout=60) as client:
        client.sendall(READ)
        return client.recv(300)[7:8] == b"\x03"
    return False


def worked_s(pid: int) -> float:
    """Processor time of a process: how long a start takes, however busy the machine is."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


@pytest.mark.parametrize("count", [4, pytest.param(200, marks=[pytest.mark.long, pytest.mark.timeout(1800)])])
def test_every_start_serves(
    tmp_path: Path,
    start: Start,
    free_tcp_port: Callable[[], int],
    free_udp_port: Callable[[], int],
    count: int,
) -> None:
    start(sys.executable, "-m", "tests.e2e.fast_lines", str(tmp_path), "plants")
    wait_until((tmp_path / "shelter-b").exists, "the simulated lines")
    ports = (free_tcp_port(), free_udp_port(), free_tcp_port())
    for name in ("auth", "priv"):
        (tmp_path / name).write_text("a pass phrase\n")
    write_config(tmp_path / "site.toml", ports, line_keys=f"baudrate = {BAUDRATE}", rest=USER.format(tmp_path))
    took_s, statuses, boots = [], [], []
    for number in range(count):
        gateway = Program((*GATEWAY, "run", "-c", str(tmp_path / "site.toml")))
        try:
            wait_until(lambda: good_reply(ports[0]), "a good reply", SERVES_S)
            took_s.append(worked_s(gateway.process.pid))
        finally:
            how = signal.SIGKILL if number % 3 else signal.SIGTERM
            statuses.append((how, gateway.end(how)))
        assert "Traceback" not in gateway.log()
        state = parse_state((tmp_path / "state" / FILE_NAME).read_bytes())
        assert state is not None
        boots.append(state)
    assert set(statuses) == {(signal.SIGKILL, -signal.SIGKILL), (signal.SIGTERM, 0)}
    assert boots == [(boots[0][0], number + 1) for number in range(count)]
    tenth = max(2, count // 10)
    first, last = sorted(took_s[:tenth]), sorted(took_s[-tenth:])
    assert last[len(last) // 2] < 2 * first[len(first) // 2] + 0.5, "starts become slower"
    with closing(open_for_reading(tmp_path / "state")) as connection:
        assert connection.execute("PRAGMA integrity_check").fetchone() == ("ok",)
        assert twice(connection) == []
    left = [path.name for path in (tmp_path / "state").iterdir()]
    assert [name for name in left if re.search(r"\.new$|\.tmp$|corrupt|lock", name)] == []


def twice(connection: sqlite3.Connection) -> list[tuple[object, ...]]:
    """Days that are there twice."""
    return connection.execute("SELECT controller, words FROM day GROUP BY 1, 2 HAVING count(*) > 1").fetchall()
