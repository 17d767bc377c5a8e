"""Function 03 × 80 registers from memory: the gateway against libmodbus (C) and pymodbus, one table a load.

Then what an idle connection costs, and what a flood does to others.

    .venv/bin/python tests/bench/bench_modbus_tcp.py [--rounds 3] [--seconds 1] [--loads 1x1 8x1 64x1 256x1 8x16]

A load is CONNECTIONSxPIPELINED. The servers run one after the other in every round, on one core, the load
generator (modbus_load.c, compiled here) on another; ratios are taken within a round and their median is
shown, because absolute rates say more about the machine and its other users than about the servers.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import platform
import shutil
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.util import find_spec
from pathlib import Path

HERE = Path(__file__).parent
UNITS = 8
START_S = 10.0
FILLED_S = 1.5  # by then the gateway has something of every unit in memory
IDLE = 500
REPLY_BYTES = 9 + 2 * 80
PACE_S = 0.005
FLOOD_S = 1.0
FLOOD_ROUNDS = 5
FLOOD_DEPTH = 64


@dataclass(frozen=True)
class Server:
    """A program that serves the registers; `command` gets the port where it says PORT."""

    name: str
    command: tuple[str, ...]


@dataclass(frozen=True)
class Load:
    """So many clients, each with so many requests under way."""

    connections: int
    depth: int

    @classmethod
    def of(cls, text: str) -> Load:
        """From `CONNECTIONSxPIPELINED`."""
        connections, _, depth = text.partition("x")
        return cls(int(connections), int(depth))


@dataclass(frozen=True)
class Run:
    """What one server did in one round."""

    rate: float  # replies a second
    cpu_us: float  # server CPU a reply, user and system
    p50_us: int
    p99_us: int
    lost: int
    wrong: int


def compiled(source: str, into: Path, *flags: str) -> str:
    """Compile one C file of this folder."""
    program = into / Path(source).stem
    subprocess.run(["gcc", "-O2", "-Wall", "-o", str(program), str(HERE / source), *flags], check=True)
    return str(program)


def servers(build: Path) -> list[Server]:
    """Those that this machine can run; says which are left out and why."""
    python = sys.executable
    out = [Server("gateway, asyncio", (python, str(HERE / "gateway_server.py"), "PORT", "asyncio"))]
    if find_spec("uvloop"):
        out.append(Server("gateway, uvloop", (python, str(HERE / "gateway_server.py"), "PORT", "uvloop")))
    else:
        say("left out: uvloop is not installed")
    out.append(Server("pymodbus", (python, str(HERE / "pymodbus_server.py"), "PORT")))
    flags = subprocess.run(
        ["pkg-config", "--cflags", "--libs", "libmodbus"], capture_output=True, text=True, check=False
    )
    if flags.returncode == 0:
        out.append(Server("libmodbus", (compiled("libmodbus_server.c", build, *flags.stdout.split()), "PORT")))
    else:
        say("left out: libmodbus (Debian package libmodbus-dev) is not installed")
    return out


def say(text: str) -> None:
    """To standard output, at once."""
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port: int = probe.getsockname()[1]
        return port


@contextlib.contextmanager
def running(server: Server, core: int) -> Iterator[tuple[int, int]]:
    """Start a server on a core; its process id and port. Ended when left."""
    port = free_port()
    command = [str(port) if word == "PORT" else word for word in server.command]
    process = subprocess.Popen(["taskset", "-c", str(core), *command])
    try:
        until = time.monotonic() + START_S
        while True:
            try:
                socket.create_connection(("127.0.0.1", port), 1).close()
                break
            except OSError:
                if process.poll() is not None or time.monotonic() > until:
                    raise
                time.sleep(0.05)
        yield process.pid, port
    finally:
        process.kill()
        process.wait()


def cpu_s(pid: int) -> float:
    """User and system time that a process has used."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def measure(generator: str, server: Server, load: Load, seconds: float, cores: tuple[int, int]) -> Run:
    """One run of the load generator against a fresh server."""
    with running(server, cores[0]) as (pid, port):
        command = ["taskset", "-c", str(cores[1]), generator, str(port), str(load.connections), str(load.depth)]
        subprocess.run([*command, "0.3", str(UNITS)], check=True, stdout=subprocess.DEVNULL)  # warm up
        before = cpu_s(pid)
        done = subprocess.run([*command, str(seconds), str(UNITS)], check=True, capture_output=True, text=True)
        used = cpu_s(pid) - before
    result = json.loads(done.stdout)
    replies = max(1, result["replies"])
    return Run(
        rate=result["replies"] / max(result["seconds"], 1e-9),
        cpu_us=used / replies * 1e6,
        p50_us=result["p50_us"],
        p99_us=result["p99_us"],
        lost=result["lost"],
        wrong=result["wrong"],
    )


def table(runs: dict[str, list[Run]]) -> str:
    """Medians over the rounds; ratios are medians of the ratios within a round."""
    peers = [name for name in ("libmodbus", "pymodbus") if name in runs]
    head = ["server", "replies/s", *(f"× {peer}" for peer in peers), "CPU µs a reply", *(f"÷ {peer}" for peer in peers)]
    head += ["p50 µs", "p99 µs", "lost", "wrong"]
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    for name, own in runs.items():
        pairs = [list(zip(own, runs[peer], strict=True)) for peer in peers]
        cells = [
            name,
            f"{statistics.median(run.rate for run in own):,.0f}",
            *(f"{statistics.median(a.rate / b.rate for a, b in pair):.2f}" for pair in pairs),
            f"{statistics.median(run.cpu_us for run in own):.1f}",
            *(f"{statistics.median(a.cpu_us / b.cpu_us for a, b in pair):.2f}" for pair in pairs),
            f"{statistics.median(run.p50_us for run in own):,.0f}",
            f"{statistics.median(run.p99_us for run in own):,.0f}",
            str(sum(run.lost for run in own)),
            str(sum(run.wrong for run in own)),
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def resident_kib(pid: int) -> int:
    """Resident memory of a process."""
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") // 1024


def request(unit: int) -> bytes:
    """80 registers from 0 of a unit."""
    return bytes.fromhex("0001 0000 0006") + bytes((unit,)) + bytes.fromhex("03 0000 0050")


def reply(client: socket.socket) -> bytes:
    """One whole reply."""
    out = b""
    while len(out) < REPLY_BYTES and (more := client.recv(REPLY_BYTES - len(out))):
        out += more
    return out


def idle_table(field: list[Server], cores: tuple[int, int]) -> str:
    """What connections cost that have asked once and are quiet now."""
    lines = ["| server | before KiB | with them KiB | KiB a connection |", "|---|---|---|---|"]
    for server in field:
        with running(server, cores[0]) as (pid, port), contextlib.ExitStack() as opened:
            time.sleep(FILLED_S)
            before = resident_kib(pid)
            for _ in range(IDLE):
                client = opened.enter_context(socket.create_connection(("127.0.0.1", port), 5))
                client.sendall(request(1))
                reply(client)
            time.sleep(0.2)
            after = resident_kib(pid)
        lines.append(f"| {server.name} | {before:,} | {after:,} | {(after - before) / IDLE:.1f} |")
    return "\n".join(lines)


def paced(port: int, seconds: float) -> list[float]:
    """Latencies in µs of a client that reads at a steady pace."""
    took = []
    with socket.create_connection(("127.0.0.1", port), 5, ("127.0.0.2", 0)) as client:
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        until = time.monotonic() + seconds
        while time.monotonic() < until:
            began = time.perf_counter()
            client.sendall(request(2))
            if len(reply(client)) != REPLY_BYTES:
                raise ConnectionError("the paced client got no reply")
            took.append((time.perf_counter() - began) * 1e6)
            time.sleep(PACE_S)
    return took


def percentiles(took: list[float]) -> tuple[float, float]:
    """Median and 99th percentile."""
    took = sorted(took)
    return took[len(took) // 2], took[int(0.99 * len(took))]


def flood_table(generator: str, gateways: list[Server], cores: tuple[int, int]) -> str:
    """The paced client alone and beside a flood, with rate limits as they are by default and without."""
    lines = ["| server | rate limit | p50 alone µs | p99 alone µs | p50 µs | p99 µs | × p99 |", "|" + "---|" * 7]
    for server in gateways:
        for limit in ("5000", "0"):
            limited = Server(server.name, (*server.command, limit))
            pairs = []
            with running(limited, cores[0]) as (_, port):
                time.sleep(FILLED_S)
                flood = ["taskset", "-c", str(cores[1]), generator, str(port), "1", str(FLOOD_DEPTH), str(2 * FLOOD_S)]
                for _ in range(FLOOD_ROUNDS):
                    alone = percentiles(paced(port, FLOOD_S))
                    with subprocess.Popen([*flood, str(UNITS)], stdout=subprocess.DEVNULL) as process:
                        time.sleep(FLOOD_S / 4)
                        pairs.append((alone, percentiles(paced(port, FLOOD_S))))
                        process.kill()
            quiet, busy = ([statistics.median(pair[at][i] for pair in pairs) for i in (0, 1)] for at in (0, 1))
            times = statistics.median(beside[1] / alone[1] for alone, beside in pairs)
            cells = [limited.name, limit if limit != "0" else "none", *(f"{us:,.0f}" for us in (*quiet, *busy))]
            lines.append("| " + " | ".join([*cells, f"{times:.2f}"]) + " |")
    return "\n".join(lines)


def where() -> str:
    """Date and machine, without which no figure means anything."""
    processor = platform.machine()
    with contextlib.suppress(OSError, StopIteration):
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        processor = next(line for line in lines if line.startswith("model name")).partition(":")[2].strip()
    cores = len(os.sched_getaffinity(0))
    return (
        f"{datetime.now(UTC):%Y-%m-%d}, {processor}, {cores} cores,"
        f" {platform.system()} {platform.release()}, Python {platform.python_version()}"
    )


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=1.0)
    loads = ["1x1", "8x1", "64x1", "256x1", "8x16"]
    parser.add_argument("--loads", nargs="*", default=loads, metavar="CONNECTIONSxPIPELINED")
    options = parser.parse_args()
    for tool in ("gcc", "taskset"):
        if shutil.which(tool) is None:
            sys.exit(f"this benchmark needs {tool}")
    usable = sorted(os.sched_getaffinity(0))
    cores = (usable[0], usable[-1])
    with tempfile.TemporaryDirectory(prefix="bench-") as folder:
        generator = compiled("modbus_load.c", Path(folder))
        field = servers(Path(folder))
        say(f"\nFC03 × 80 registers, {options.rounds} rounds of {options.seconds:g} s a server; {where()}")
        for load in map(Load.of, options.loads):
            runs: dict[str, list[Run]] = {server.name: [] for server in field}
            for _ in range(options.rounds):
                for server in field:
                    runs[server.name].append(measure(generator, server, load, options.seconds, cores))
            say(f"\n{load.connections} connections × {load.depth} under way\n\n{table(runs)}")
        gateways = [server for server in field if server.name.startswith("gateway")]
        say(f"\nResident memory of a server with {IDLE} idle connections\n\n{idle_table(field, cores)}")
        say(
            f"\nA client that reads once in {PACE_S * 1000:g} ms, alone and beside one that floods with"
            f" {FLOOD_DEPTH} requests under way, both beside polls\n\n{flood_table(generator, gateways, cores)}"
        )


if __name__ == "__main__":
    main()
