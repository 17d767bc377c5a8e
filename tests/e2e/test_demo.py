"""The demo as a user has it: on a terminal, with its commands pasted elsewhere, and ended by Ctrl-C."""

from __future__ import annotations

import contextlib
import fcntl
import os
import re
import select
import signal
import socket
import struct
import subprocess
import termios
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.e2e.programs import GATEWAY, REPOSITORY, alive, children_of, environment, wait_until
from tests.machine import Bystander
from tests.netsnmp import without_new_folders

COMMAND = re.compile(r"^(?:mbpoll|snmp\w+|curl) .*\S", re.MULTILINE)
ENDS_S = 10.0
"""More than twenty times what it takes where nothing else runs. What bounds it is in tests/cli/test_children.py."""

GIVEN_UP_S = 60.0

ESCAPE = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")


class Terminal:
    """A process on a terminal of its own."""

    def __init__(self, arguments: list[str], columns: int, rows: int, folder: Path) -> None:
        self.master, slave = os.openpty()
        fcntl.ioctl(slave, termios.TIOCSWINSZ, struct.pack("HHHH", rows, columns, 0, 0))
        self.process = subprocess.Popen(
            arguments,
            cwd=REPOSITORY,
            preexec_fn=lambda: os.login_tty(slave),  # noqa: PLW1509  # makes it the controlling terminal: Ctrl-C
            env={**environment(), "TERM": "xterm-256color", "COLUMNS": "", "LINES": "", "TMPDIR": str(folder)},
        )
        os.close(slave)
        self.raw = ""

    def read(self, timeout_s: float = 0.05) -> bool:
        """Take what was written; False at its end."""
        if not select.select([self.master], [], [], timeout_s)[0]:
            return True
        try:
            data = os.read(self.master, 65536)
        except OSError:  # a terminal without processes
            return False
        self.raw += data.decode()
        return bool(data)

    def text(self) -> str:
        """Everything that was shown, without colours and movements."""
        return ESCAPE.sub("", self.raw).replace("\r\n", "\n").replace("\r", "\n")

    def wait_for(self, pattern: str, timeout_s: float = 60.0) -> None:
        """Wait until something like it was shown."""

        def shown() -> bool:
            self.read()
            return re.search(pattern, self.text()) is not None

        wait_until(shown, f"{pattern!r} on the terminal", timeout_s)

    def interrupt(self) -> int:
        """Press Ctrl-C; the exit status, which comes within `ENDS_S`."""
        with ends_soon():
            os.write(self.master, b"\x03")
            return self.ended()

    def ended(self) -> int:
        """Read to the end; the exit status."""
        while self.read() and self.process.poll() is None:
            pass
        self.read(0)
        return self.process.wait(timeout=GIVEN_UP_S)

    def close(self) -> None:
        """End everything."""
        if self.process.poll() is None:
            self.process.terminate()
            self.process.wait(timeout=GIVEN_UP_S)
        os.close(self.master)


OpenTerminal = Callable[..., Terminal]


@contextlib.contextmanager
def ends_soon() -> Iterator[None]:
    """What happens in it takes less than `ENDS_S`."""
    with Bystander() as passing:
        yield
    assert passing.s < ENDS_S


@pytest.fixture
def ports(free_tcp_port: Callable[[], int], free_udp_port: Callable[[], int]) -> list[str]:
    """The demo's options that choose free ports."""
    numbers = {"modbus": free_tcp_port(), "snmp": free_udp_port(), "http": free_tcp_port()}
    return [text for face, number in numbers.items() for text in (f"--{face}-port", str(number))]


@pytest.fixture
def terminal(ports: list[str], tmp_path: Path) -> Iterator[OpenTerminal]:
    """`terminal(columns=80, rows=24)` starts the demo on a terminal of that size."""
    opened: list[Terminal] = []

    def opener(columns: int = 80, rows: int = 24) -> Terminal:
        opened.append(Terminal([*GATEWAY, "demo", *ports], columns, rows, tmp_path))
        return opened[-1]

    yield opener
    for each in opened:
        each.close()


@pytest.mark.peer
def test_the_printed_commands_work_and_ctrl_c_leaves_nothing(
    terminal: OpenTerminal, peer: Callable[[str], str], tmp_path: Path
) -> None:
    for program in ("mbpoll", "snmpwalk", "snmptable", "curl"):
        peer(program)
    demo = terminal(columns=80, rows=24)
    demo.wait_for(r"14 +array-4[^\n]*online\s+hilltop(.|\n)*hilltop +up +\d+%(.|\n)*/readyz")
    commands = list(dict.fromkeys(COMMAND.findall(demo.text())))
    assert [command.split()[0] for command in commands] == ["mbpoll", "mbpoll", "snmpwalk", "snmptable", "curl", "curl"]
    # Its own words cut at the width of the terminal are the ones that would be pasted.
    for command in commands:
        assert len(command) <= 80
        done = subprocess.run(
            ["bash", "-c", command], cwd=REPOSITORY, capture_output=True, text=True, env=environment(), check=False
        )
        assert done.returncode == 0, f"{command}\n{done.stdout}{done.stderr}"
        assert without_new_folders(done.stderr) == ""
        expected = {
            "mbpoll": r"\[(16|33)\]:\s+(0x)?[0-9A-F]+",
            "snmpwalk": r"pgwBatteryVoltage\.13 = INTEGER: \d+ millivolts",
            "snmptable": r"array-1 .*\n.*array-2 .*\n.*array-3 ",
            "curl": r'battery_voltage_volts\{device="array-3"|^ready$',
        }[command.split()[0]]
        assert re.search(expected, done.stdout), f"{command}\n{done.stdout}"
    children = children_of(demo.process.pid)
    assert len(children) == 3
    assert demo.interrupt() == 0
    assert alive(children) == []
    assert list(tmp_path.iterdir()) == []
    assert "Traceback" not in demo.text()
    assert demo.raw.rindex("\x1b[?25h") > demo.raw.rindex("\x1b[?25l")  # the cursor is back


def test_a_wide_terminal_shows_what_each_command_does(terminal: OpenTerminal) -> None:
    demo = terminal(columns=120, rows=40)
    demo.wait_for(r"# whether the gateway is ready\ncurl ")
    row = re.search(r"11 +array-1 +[\d.]+ V +[\d.]+ V +[\d.]+ V +\w+ +[\d.]+ s +online", demo.text())
    assert row is not None, demo.text()
    assert max(len(line) for line in demo.text().splitlines()) <= 120
    with ends_soon():
        demo.process.terminate()
        assert demo.ended() == 0


def test_without_a_terminal_there_are_plain_lines(ports: list[str]) -> None:
    process = subprocess.Popen(
        [*GATEWAY, "demo", *ports], cwd=REPOSITORY, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    try:
        assert process.stdout is not None
        shown = []
        for line in process.stdout:
            shown.append(line.rstrip())
            if line.startswith("hilltop up"):
                break
    finally:
        with ends_soon():
            process.send_signal(signal.SIGTERM)
            _, said = process.communicate(timeout=GIVEN_UP_S)
    assert process.returncode == 0
    assert said == ""
    assert sum(COMMAND.match(line) is not None for line in shown) == 6
    assert "\x1b" not in "".join(shown)
    assert re.match(r"shelter-a/array-1 unit=11 battery=[\d.]+V/-?[\d.]+A array=", shown[-7])


def test_a_reader_that_leaves_ends_it(ports: list[str]) -> None:
    command = " ".join([*GATEWAY, "demo", *ports, "| head -n 1"])
    done = subprocess.run(
        ["bash", "-c", f"set -o pipefail; {command}"],
        cwd=REPOSITORY,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.stdout.startswith("Try these in another terminal")
    assert (done.returncode, done.stderr) == (0, "")


def test_taken_ports_are_all_named_with_the_option_to_choose_others(ports: list[str]) -> None:
    with contextlib.ExitStack() as stack:
        for position, kind in ((1, socket.SOCK_STREAM), (3, socket.SOCK_DGRAM), (5, socket.SOCK_STREAM)):
            holder = stack.enter_context(socket.socket(socket.AF_INET, kind))
            holder.bind(("127.0.0.1", int(ports[position])))
            if kind is socket.SOCK_STREAM:
                holder.listen()
        done = subprocess.run([*GATEWAY, "demo", *ports], cwd=REPOSITORY, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert done.stdout == ""
    expected = [
        f"{face} port 127.0.0.1:{ports[position]}: Address already in use. Choose another: {option} "
        for face, option, position in (
            ("Modbus TCP", "--modbus-port", 1),
            ("SNMP (UDP)", "--snmp-port", 3),
            ("HTTP", "--http-port", 5),
        )
    ]
    lines = done.stderr.splitlines()
    assert len(lines) == 3
    assert all(line.startswith(start) for line, start in zip(lines, expected, strict=True))


def test_a_storm_of_signals_ends_it_like_one(terminal: OpenTerminal) -> None:
    demo = terminal()
    demo.wait_for("array-3")
    children = children_of(demo.process.pid)
    assert len(children) == 3
    with ends_soon():
        for number in (signal.SIGHUP, signal.SIGTERM, signal.SIGINT) * 20:
            demo.process.send_signal(number)
        assert demo.ended() == 0
    assert alive(children) == []
    assert "Traceback" not in demo.text()


def test_a_terminal_that_is_closed_ends_it(terminal: OpenTerminal) -> None:
    demo = terminal()
    demo.wait_for("array-3")
    children = children_of(demo.process.pid)
    assert len(children) == 3
    with ends_soon():
        os.close(demo.master)
        demo.master = os.open(os.devnull, os.O_RDONLY)  # for the fixture to close
        assert demo.process.wait(timeout=GIVEN_UP_S) == 0
    assert alive(children) == []


def test_ctrl_c_while_it_starts_ends_it(terminal: OpenTerminal) -> None:
    demo = terminal()
    demo.wait_for("Starting the gateway")
    children = children_of(demo.process.pid)
    assert children
    assert demo.interrupt() == 0
    assert alive(children) == []
    assert "Traceback" not in demo.text()


def test_a_killed_demo_leaves_no_orphans(terminal: OpenTerminal) -> None:
    demo = terminal()
    demo.wait_for("array-3")
    children = children_of(demo.process.pid)
    assert len(children) == 3
    with ends_soon():
        demo.process.kill()
        demo.process.wait()
        wait_until(lambda: not alive(children), "the end of simulator and gateway")


def test_a_gateway_that_ends_is_told_with_its_log(terminal: OpenTerminal) -> None:
    demo = terminal()
    demo.wait_for("array-3")
    *_, gateway = children_of(demo.process.pid)
    os.kill(gateway, signal.SIGKILL)
    assert demo.ended() == 1
    assert "prostar-gateway run ended with status -9" in demo.text()
