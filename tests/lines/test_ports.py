"""Opening a port: who holds it, what is wrong, and that nothing is left behind."""

from __future__ import annotations

import fcntl
import logging
import os
import pty
import select
import socket
import subprocess
import sys
import termios
from collections.abc import Callable
from pathlib import Path

import pytest

from gateway.core.settings import LineSettings
from gateway.errors import PortError
from gateway.lines.ports import _name_intruder, close_port, holder_of, open_port

HOLD = "import fcntl, os, sys; f = os.open(sys.argv[1], os.O_RDWR | os.O_NOCTTY); fcntl.flock(f, fcntl.LOCK_EX);"
HOLD += "print('held', flush=True); sys.stdin.read()"


def settings(port: str) -> LineSettings:
    return LineSettings(name="shelter-a", index=1, port=port)


def test_the_holder_of_a_port_is_named_by_program_and_process() -> None:  # F19
    master, slave = pty.openpty()
    path = os.ttyname(slave)
    with subprocess.Popen([sys.executable, "-c", HOLD, path], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == b"held\n"
        name = Path(f"/proc/{holder.pid}/comm").read_text().strip()
        assert holder_of(path, but=os.getpid()) == f"{name} (process {holder.pid})"
        os.close(slave)
        with pytest.raises(PortError, match=rf"{path}: in use by .*\(process {holder.pid}\)"):
            open_port(settings(path))
        holder.kill()
    os.close(master)


CONTAINER = """
import fcntl, os, struct, subprocess, sys
UNLOCK = 0x40045431  # TIOCSPTLCK
folder, name = sys.argv[1:]
os.mkdir(folder)
if subprocess.run(["mount", "-t", "devpts", "-o", "newinstance,ptmxmode=666", "none", folder]).returncode:
    sys.exit("not permitted")
while not os.path.exists(f"{folder}/{name}"):
    master = os.open(f"{folder}/ptmx", os.O_RDWR | os.O_NOCTTY)
fcntl.ioctl(master, UNLOCK, struct.pack("i", 0))
os.open(f"{folder}/{name}", os.O_RDWR | os.O_NOCTTY)
print("held", flush=True)
sys.stdin.read()
"""
"""A program in a container: its terminals are numbered from 0 again."""


@pytest.mark.peer
def test_the_terminal_of_that_number_in_a_container_is_another_one(peer: Callable[[str], str], tmp_path: Path) -> None:
    master, slave = pty.openpty()
    path = os.ttyname(slave)
    command = [peer("unshare"), "--user", "--map-root-user", "--mount", sys.executable, "-c", CONTAINER]
    with subprocess.Popen(
        [*command, str(tmp_path / "pts"), Path(path).name],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    ) as holder:
        assert holder.stdout is not None
        assert holder.stderr is not None
        if holder.stdout.readline() != b"held\n":
            pytest.skip(f"namespaces are not permitted here: {holder.stderr.read().decode().strip()}")
        assert holder_of(path) == "this program"
        assert holder_of(path, but=os.getpid()) == ""
        holder.kill()
    os.close(slave)
    os.close(master)


def test_a_port_that_this_program_has_twice_is_said_to_be_its_own() -> None:
    master, slave = pty.openpty()
    fcntl.flock(slave, fcntl.LOCK_EX)
    with pytest.raises(PortError, match="in use by this program"):
        open_port(settings(os.ttyname(slave)))
    os.close(slave)
    os.close(master)


def test_a_program_that_opened_the_device_without_a_lock_is_named(caplog: pytest.LogCaptureFixture) -> None:
    with subprocess.Popen(["sleep", "60"], stdin=subprocess.DEVNULL) as intruder:
        _name_intruder(settings("/dev/null"))
        intruder.kill()
    assert any('event=port_shared line=shelter-a port="/dev/null" with="' in message for message in caplog.messages)


def test_an_open_port_is_raw_locked_and_tells_empty_from_gone(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.WARNING)
    master, slave = pty.openpty()
    port = open_port(settings(os.ttyname(slave)))
    attributes = termios.tcgetattr(port.fileno())
    assert not attributes[3] & (termios.ICANON | termios.ECHO | termios.ISIG)
    assert attributes[6][termios.VMIN] == 1
    os.set_blocking(port.fileno(), False)
    with pytest.raises(BlockingIOError):  # not b"", which is what a device gives that is gone
        os.read(port.fileno(), 1)
    with pytest.raises(BlockingIOError):
        fcntl.flock(slave, fcntl.LOCK_EX | fcntl.LOCK_NB)
    close_port(port)
    fcntl.flock(slave, fcntl.LOCK_EX | fcntl.LOCK_NB)
    os.close(slave)
    os.close(master)
    assert caplog.messages == []


@pytest.mark.parametrize(
    ("path", "why"), [("/nonexistent/ttyUSB0", "no such device"), (str(Path(__file__).parent), "irectory")]
)
def test_what_is_wrong_with_a_path_is_said(path: str, why: str) -> None:
    with pytest.raises(PortError, match=why):
        open_port(settings(path))


def test_a_connection_is_watched_and_leaves_nothing_open_when_the_other_end_is_gone() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = open_port(settings(f"socket://127.0.0.1:{server.getsockname()[1]}"))
        far, _ = server.accept()
        connection = vars(port)["_socket"]
        assert connection.getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE) == 1
        assert connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT) == 12_000
        far.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")
        far.close()  # a reset: shutting down our end fails, and pyserial then forgets to close it
        select.select([connection], [], [], 5)
        close_port(port)
        assert connection.fileno() == -1
