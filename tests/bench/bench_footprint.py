"""What a gateway takes: memory with 247 controllers and 64 clients, and the time from start to the first good reply.

    .venv/bin/python tests/bench/bench_footprint.py [--parts memory start] [--seconds 60] [--starts 7]

memory   247 controllers on 32 simulated lines, all faces and the history on; 64 Modbus TCP clients read one after
         another, an SNMP walk and a scrape run every few seconds; resident memory once a second
start    from the start of the process to the first good Modbus TCP reply, one controller on a line at 9600 8N2; less
         the line's own time, which is the wire's for the polls that come first

The bars: below 80 MiB and flat; below 2 s and the line's own time.
"""

from __future__ import annotations

import argparse
import contextlib
import signal
import socket
import statistics
import struct
import subprocess
import sys
import threading
import time
import urllib.request
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Self

HERE = Path(__file__).parent
REPOSITORY = HERE.parents[1]
sys.path.insert(0, str(REPOSITORY))

from tests.bench.bench_line import (  # noqa: E402  # a script has to say where the repository is
    ENVIRONMENT,
    READ_S,
    cpu_s,
    free_port,
    say,
    shares,
    simulated,
    table,
    where,
)

DEVICES, LINES, CLIENTS = 247, 32, 64
READ = struct.pack(">HHHB", 1, 0, 6, 0)[:6]  # transaction 1, protocol 0, six bytes to come
BAR_MIB, BAR_S = 80.0, 2.0
START_S = 60.0


def memory_kib(pid: int) -> tuple[int, int]:
    """Resident memory, and what of it is the process's alone."""
    rows = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
    fields = {row.split(":")[0]: int(row.split()[1]) for row in rows[1:]}
    return fields["Rss"], fields["Private_Clean"] + fields["Private_Dirty"]


def configuration(folder: Path, share: Sequence[int], baudrate: int, ports: tuple[int, int, int]) -> Path:
    modbus, snmp, http = ports
    text = f'site = "bench"\nstate_dir = "{folder / "state"}"\n'
    unit = 0
    for number, count in enumerate(share):
        text += f'[[line]]\nname = "line{number}"\nport = "{folder / f"line{number}"}"\nbaudrate = {baudrate}\n'
        for address in range(1, count + 1):
            unit += 1
            text += f'[[line.device]]\nname = "array-{unit}"\naddress = {address}\nunit_id = {unit}\n'
            text += 'model = "prostar-mppt"\n'
    text += f'[modbus]\nlisten = ["127.0.0.1:{modbus}"]\nmax_connections = 128\nmax_per_client = 128\n'
    text += f'[http]\nlisten = ["127.0.0.1:{http}"]\n'
    text += f'[snmp]\nlisten = ["127.0.0.1:{snmp}"]\n[[snmp.community]]\nname = "bench"\nsource = ["127.0.0.0/8"]\n'
    path = folder / "bench.toml"
    path.write_text(text)
    return path


def read(client: socket.socket, unit: int, first: int = 0x0010, count: int = 16) -> bytes:
    """One read of holding registers; gives the reply's PDU."""
    client.sendall(READ + struct.pack(">BBHH", unit, 3, first, count))
    with client.makefile("rb") as stream:
        head = stream.read(7)
        return stream.read(int.from_bytes(head[4:6], "big") - 1) if len(head) == 7 else b""


def online(http: int) -> int:
    with urllib.request.urlopen(f"http://127.0.0.1:{http}/metrics", timeout=10) as reply:
        return sum(row.startswith(b"morningstar_up{") and row.rstrip().endswith(b" 1.0") for row in reply)


def wait_online(http: int, devices: int) -> None:
    until = time.monotonic() + START_S
    while time.monotonic() < until:
        with contextlib.suppress(OSError):
            if online(http) >= devices:
                return
        time.sleep(0.5)
    raise TimeoutError("not all controllers came online")


class Load:
    """64 clients that read, a scraper, and a walker where there is one."""

    def __init__(self, ports: tuple[int, int, int]) -> None:
        self._ports = ports
        self._stop = threading.Event()
        self.replies = 0
        self._threads = [threading.Thread(target=self._read), threading.Thread(target=self._look)]

    def __enter__(self) -> Self:
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        for thread in self._threads:
            thread.join()

    def _read(self) -> None:
        with contextlib.ExitStack() as stack:
            clients = [
                stack.enter_context(socket.create_connection(("127.0.0.1", self._ports[0]), 10)) for _ in range(CLIENTS)
            ]
            while not self._stop.is_set():
                for number, client in enumerate(clients):
                    self.replies += read(client, 1 + (self.replies + number) % DEVICES)[:1] == b"\x03"
                self._stop.wait(0.02)

    def _look(self) -> None:
        walk = ["snmpbulkwalk", "-v2c", "-c", "bench", "-Cr40", f"127.0.0.1:{self._ports[1]}", "1.3.6.1.4.1.32473"]
        while not self._stop.wait(5.0):
            online(self._ports[2])
            with contextlib.suppress(FileNotFoundError):
                subprocess.run(walk, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, check=False)


def memory(seconds: int) -> None:
    share = shares(DEVICES, LINES)
    rows = []
    for loop in ("uvloop", "asyncio") if find_spec("uvloop") else ("asyncio",):
        plans = [f"line{number}=1-{count}" for number, count in enumerate(share)]
        with simulated(plans, baudrate=115200) as (folder, _):
            ports = (free_port(), free_port(), free_port())
            path = configuration(folder, share, 115200, ports)
            with (folder / "log").open("wb") as log:
                command = [sys.executable, "-m", "gateway", "run", "-c", str(path), "--loop", loop]
                process = subprocess.Popen(command, stderr=log, env=ENVIRONMENT)
                try:
                    wait_online(ports[2], DEVICES)
                    quiet = memory_kib(process.pid)[0]
                    with Load(ports) as load:
                        time.sleep(10.0)
                        samples = []
                        for _ in range(seconds):
                            samples.append(memory_kib(process.pid))
                            time.sleep(1.0)
                finally:
                    process.send_signal(signal.SIGTERM)
                    process.wait()
        resident = [rss for rss, _ in samples]
        slope = statistics.linear_regression(range(len(resident)), resident).slope * 3600 / 1024
        rows.append(
            (
                loop,
                f"{quiet / 1024:.1f}",
                f"{max(resident) / 1024:.1f}",
                f"{samples[-1][1] / 1024:.1f}",
                f"{min(resident[-10:]) / 1024 - min(resident[:10]) / 1024:+.2f}",
                f"{slope:+.1f}",
                f"{load.replies / (seconds + 10):,.0f}",
            )
        )
    say(f"\n{DEVICES} controllers on {LINES} lines, {CLIENTS} clients, {seconds} s; the bar is {BAR_MIB:g} MiB\n")
    head = (
        "loop",
        "MiB without clients",
        "MiB at most",
        "of it its own",
        "last 10 s less first",
        "slope MiB/h",
        "replies/s",
    )
    say(table(head, rows))


def start(count: int) -> None:
    took: list[float] = []
    worked: list[float] = []
    for _ in range(count):
        with simulated(["line0=1"]) as (folder, _):
            ports = (free_port(), free_port(), free_port())
            path = configuration(folder, [1], 9600, ports)
            with (folder / "log").open("wb") as log:
                began = time.monotonic()
                command = [sys.executable, "-m", "gateway", "run", "-c", str(path)]
                process = subprocess.Popen(command, stderr=log, env=ENVIRONMENT)
                try:
                    while True:
                        with (
                            contextlib.suppress(OSError),
                            socket.create_connection(("127.0.0.1", ports[0]), 10) as client,
                        ):
                            if read(client, 1)[:1] == b"\x03":
                                break
                        time.sleep(0.005)
                        if time.monotonic() > began + START_S:
                            raise TimeoutError("no good reply")
                    took.append(time.monotonic() - began)
                    worked.append(cpu_s(process.pid))
                finally:
                    process.send_signal(signal.SIGTERM)
                    process.wait()
    say(f"\nFrom the start of the process to the first good reply, one controller at 9600 8N2, {count} starts\n")
    figures = (statistics.median(took), min(took), max(took), statistics.median(worked), READ_S)
    head = ("median s", "best s", "worst s", "CPU s", "one read on the wire s")
    say(table(head, [[f"{figure:.2f}" for figure in figures]]))


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--parts", nargs="+", choices=("memory", "start"), default=("memory", "start"))
    parser.add_argument("--seconds", type=int, default=60)
    parser.add_argument("--starts", type=int, default=7)
    options = parser.parse_args()
    say(f"\n{where()}")
    if "memory" in options.parts:
        memory(options.seconds)
    if "start" in options.parts:
        start(options.starts)


if __name__ == "__main__":
    main()
