"""What the end-to-end tests share: processes with logs that can be waited for, and a gateway over simulated lines."""

from __future__ import annotations

import contextlib
import ctypes
import os
import queue
import re
import signal
import ssl
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parents[2]
GATEWAY = (sys.executable, "-m", "gateway")
DEMO_DEVICES = (("shelter-a", "array-1", 1, 11), ("shelter-a", "array-2", 2, 12), ("shelter-b", "array-3", 1, 13))
"""Line, name, address, unit id: two lines, three controllers, the factory address 1 on both lines."""

MIXED_DEVICES = (*DEMO_DEVICES, ("shelter-b", "array-4", 2, 14))
"""The same with the TriStar that `simulate` has beside them."""

ALL_DEVICES = (*MIXED_DEVICES, ("hilltop", "array-5", 1, 15))
"""The same with a TriStar on a network of its own, which closes each connection after its reply."""

MODELS: Mapping[str, str] = {"array-4": "tristar-mppt", "array-5": "tristar-mppt"}


PR_SET_PDEATHSIG = 1
_PRCTL = ctypes.CDLL(None).prctl
"""Known before the first fork: nothing may be loaded between that and exec."""


class Program:
    """A running process whose standard error can be waited for, line by line.

    It ends with the thread that started it, however that ends: of tests that are killed nothing is left.
    """

    def __init__(self, arguments: Sequence[str], **variables: str) -> None:
        """`variables` are added to the environment."""
        self.process = subprocess.Popen(
            arguments,
            cwd=REPOSITORY,
            env={**os.environ, **variables},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            start_new_session=True,
            preexec_fn=lambda: _PRCTL(PR_SET_PDEATHSIG, signal.SIGTERM),  # noqa: PLW1509 - one system call
        )
        self.seen: list[str] = []
        self._lines: queue.Queue[str | None] = queue.Queue()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stderr is not None
        for line in self.process.stderr:
            self._lines.put(line.decode().rstrip())
        self._lines.put(None)

    def wait_for(self, pattern: str, timeout_s: float = 60.0) -> str:
        """The next line of its log that matches; fails with the log when none comes in time."""
        deadline = time.monotonic() + timeout_s
        while True:
            try:
                line = self._lines.get(timeout=max(0.0, deadline - time.monotonic()))
            except queue.Empty:
                line = None
            if line is None:
                pytest.fail(f"no line like {pattern!r}:\n" + "\n".join(self.seen))
            self.seen.append(line)
            if re.search(pattern, line):
                return line

    def log(self) -> str:
        """Everything it wrote until now; complete once it has ended."""
        if self.process.poll() is not None:
            self._reader.join()
        with contextlib.suppress(queue.Empty):
            while True:
                line = self._lines.get_nowait()
                if line is not None:
                    self.seen.append(line)
        return "\n".join(self.seen)

    def end(self, number: signal.Signals = signal.SIGTERM, timeout_s: float = 30.0) -> int:
        """Send a signal and wait; gives the exit status."""
        if self.process.poll() is None:
            self.process.send_signal(number)
        return self.ended(timeout_s)

    def ended(self, timeout_s: float = 30.0) -> int:
        """Wait until it ends by itself, for a second signal would not let it end in order; gives the exit status."""
        try:
            return self.process.wait(timeout=timeout_s)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
            raise
        finally:
            self._reader.join()
            assert self.process.stderr is not None
            self.process.stderr.close()


class StandsStill:
    """How the gateway is started so that its loop, and nothing else of it, stands still upon a signal."""

    SIGNAL = signal.SIGUSR1
    SAID = "^standing still$"

    def __init__(self, folder: Path) -> None:
        self._fifo = folder / "go-on"
        os.mkfifo(self._fifo)
        # Python handles signals in the main thread, whose the loop is; who opens a pipe lets other threads run.
        stand = f"os.write(2, b'standing still\\n'); open({str(self._fifo)!r}).read()"
        text = f"import os, signal\ndef stand(*_):\n    {stand}\nsignal.signal({int(self.SIGNAL)}, stand)\n"
        self.command = (sys.executable, "-c", f"{text}from gateway.cli.main import main\nmain()\n")

    def go_on(self) -> None:
        """Let the loop turn again."""
        self._fifo.write_text("")


def wait_until(condition: Callable[[], object], what: str, timeout_s: float = 60.0) -> None:
    """Ask until it is true; fails naming what was waited for."""
    deadline = time.monotonic() + timeout_s
    while not condition():
        if time.monotonic() > deadline:
            pytest.fail(f"waited {timeout_s:.0f} s for {what}")
        time.sleep(0.02)


@dataclass
class Running:
    """A gateway over simulated lines."""

    folder: Path
    modbus: int
    snmp: int
    http: int
    gateway: Program
    simulator: Program | None
    trusted: ssl.SSLContext | None = None  # HTTP is asked by TLS, and whom it trusts

    def get(self, path: str) -> tuple[int, str]:
        """Status and text of an HTTP reply; 0 when there is none."""
        try:
            url = f"http{'s' if self.trusted else ''}://127.0.0.1:{self.http}{path}"
            with urllib.request.urlopen(url, timeout=30, context=self.trusted) as reply:
                return reply.status, reply.read().decode()
        except urllib.error.HTTPError as error:
            with error:
                return error.code, error.read().decode()
        except OSError:
            return 0, ""

    def up(self) -> dict[str, float]:
        """`morningstar_up` by device name."""
        found = re.findall(r'^morningstar_up\{device="([^"]*)".* ([01])\.0$', self.get("/metrics")[1], re.MULTILINE)
        return {name: float(value) for name, value in found}

    def wait_online(self, *devices: str, timeout_s: float = 60.0) -> None:
        """Wait until these devices (all when none is named) are online."""

        def online() -> bool:
            up = self.up()
            return bool(up) and all(up.get(name) == 1 for name in devices or up)

        wait_until(online, f"{devices or 'all'} online", timeout_s)


Start = Callable[..., Program]
Launch = Callable[..., Running]


def write_config(
    path: Path,
    ports: tuple[int, int, int],
    devices: Sequence[tuple[str, str, int, int]] = DEMO_DEVICES,
    line_keys: str = "",
    rest: str = "",
    *,
    modbus_keys: str = "",
    http_keys: str = "",
    models: Mapping[str, str] = MODELS,
    upstreams: Mapping[str, int] | None = None,
) -> None:
    """A configuration whose lines are links in the folder of the file; `models` by name, ProStars else.

    `upstreams`: the lines that are Modbus TCP servers on this machine, with their ports.
    """
    modbus, snmp, http = ports
    text = f'site = "ridge-07"\nstate_dir = "{path.parent / "state"}"\n'
    for line in dict.fromkeys(device[0] for device in devices):
        if upstreams and line in upstreams:
            text += f'[[line]]\nname = "{line}"\nport = "tcp://127.0.0.1:{upstreams[line]}"\n'
        else:
            text += f'[[line]]\nname = "{line}"\nport = "{path.parent / line}"\n{line_keys}\n'
        for at, name, address, unit in devices:
            if at == line:
                text += f'[[line.device]]\nname = "{name}"\naddress = {address}\nunit_id = {unit}\n'
                text += f'model = "{models.get(name, "prostar-mppt")}"\n'
    text += f'[modbus]\nlisten = ["127.0.0.1:{modbus}"]\n{modbus_keys}\n'
    text += f'[http]\nlisten = ["127.0.0.1:{http}"]\n{http_keys}\n'
    text += f'[snmp]\nlisten = ["127.0.0.1:{snmp}"]\n'
    text += '[[snmp.community]]\nname = "public"\nsource = ["127.0.0.0/8"]\n'
    path.write_text(text + rest)


def alive(pids: Sequence[int]) -> list[int]:
    """Those of the processes that still run (zombies do not)."""
    running = []
    for pid in pids:
        with contextlib.suppress(OSError):
            state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
            if state != "Z":
                running.append(pid)
    return running


def children_of(pid: int) -> list[int]:
    """The process ids of a process's children."""
    return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def environment() -> dict[str, str]:
    """The environment for foreign programs: English, and no settings of this machine's user."""
    return {**os.environ, "LC_ALL": "C.UTF-8", "SNMPCONFPATH": "/nonexistent"}
