"""The serial line: how near the gateway is to its limit, and what clients get out of it.

    .venv/bin/python tests/bench/bench_line.py [--parts limit clients dead faults growth] [--seconds 10]

limit    one client alone reads 82 registers again and again at 9600 8N2: the gateway on both loops, pymodbus
clients  16 Modbus TCP clients ask 10 controllers on one line: the gateway, a bridge made of pymodbus, modbus-proxy
dead     the same with one of the ten dead
faults   the same with 2 % of each kind of fault
growth   1 to 247 controllers on 1 to 32 lines at 115200 baud, polled as often in sum: CPU a poll

The lines are simulated on ptys (line_simulator.py), without turnaround, and tell how long they were in use and
whether anybody broke the 3.5 characters of silence. The simulator, and in the first part the clients, run at real-time
priority where they may, so that the machine's other work is not measured.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import os
import platform
import shutil
import signal
import socket
import statistics
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.util import find_spec
from pathlib import Path

HERE = Path(__file__).parent
REPOSITORY = HERE.parents[1]
sys.path.insert(0, str(REPOSITORY))

from gateway.core.settings import PollSettings  # noqa: E402  # a script has to say where the repository is
from gateway.devices.schema import load_map  # noqa: E402
from gateway.simulator.oracle import OracleController  # noqa: E402
from tests.core.virtual_line import make_line  # noqa: E402

READ_S = 177 * 11 / 9600 + 2 * 3.5 * 11 / 9600  # request, reply and a gap after each: 210.8 ms
START_S = 30.0
CLIENTS = 16
DEVICES = 10
MAX_AGE_S = 5.0
PATIENCE_S = 30.0  # of the clients; with the usual 1 to 3 s a peer would lose most requests
GROWTH = ((1, 1), (16, 4), (64, 16), (247, 32))  # devices, lines
POLLS_PER_S = 60.0
VIRTUAL_POLLS = 2000
ROUNDS = 3
MODBUS_PROXY = "modbus-proxy==0.8.0"
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(REPOSITORY)}


def say(text: str) -> None:
    """To standard output, at once."""
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    return "\n".join("| " + " | ".join(row) + " |" for row in (head, ["---"] * len(head), *rows))


def where() -> str:
    """Date and machine, without which no figure means anything."""
    processor = platform.machine()
    with contextlib.suppress(OSError, StopIteration):
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        processor = next(line for line in lines if line.startswith("model name")).partition(":")[2].strip()
    return (
        f"{datetime.now(UTC):%Y-%m-%d}, {processor}, {len(os.sched_getaffinity(0))} cores, {platform.system()}"
        f" {platform.release()}, Python {platform.python_version()}, load average {os.getloadavg()[0]:.1f}"
    )


def first() -> None:
    """Run before everything else, where that is allowed; called in a child before it becomes a program."""
    with contextlib.suppress(PermissionError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(10))


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port: int = probe.getsockname()[1]
        return port


def cpu_s(pid: int) -> float:
    """User and system time that a process has used."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


class Simulator:
    """Simulated lines in a process of their own."""

    def __init__(self, folder: Path, plans: Sequence[str], baudrate: int = 9600, chaos_percent: float = 0.0) -> None:
        command = [sys.executable, str(HERE / "line_simulator.py"), str(folder), str(baudrate), str(chaos_percent)]
        self.process = subprocess.Popen([*command, *plans], stdout=subprocess.PIPE, env=ENVIRONMENT)
        assert self.process.stdout is not None
        if self.process.stdout.readline() != b"open\n":
            raise RuntimeError("the simulator did not start")

    def begin(self) -> None:
        """What was seen until now does not count."""
        self.process.send_signal(signal.SIGUSR1)

    def seen(self) -> list[dict[str, float]]:
        """What each line saw; ends the simulator."""
        self.process.terminate()
        said = self.process.communicate()[0]
        found: list[dict[str, float]] = json.loads(said)
        return found


@contextlib.contextmanager
def simulated(
    plans: Sequence[str], baudrate: int = 9600, chaos_percent: float = 0.0
) -> Iterator[tuple[Path, Simulator]]:
    """Lines in a folder; ended when left."""
    with tempfile.TemporaryDirectory(prefix="bench-") as name:
        simulator = Simulator(Path(name), plans, baudrate, chaos_percent)
        try:
            yield Path(name), simulator
        finally:
            simulator.process.kill()
            simulator.process.wait()


@contextlib.contextmanager
def running(command: Sequence[str], port: int, environment: dict[str, str]) -> Iterator[int]:
    """A server; gives its process id as soon as somebody answers at the port."""
    with tempfile.TemporaryFile() as log:
        process = subprocess.Popen(command, stdout=log, stderr=log, env=environment)
        try:
            until = time.monotonic() + START_S
            while True:
                try:
                    socket.create_connection(("127.0.0.1", port), 1).close()
                    break
                except OSError:
                    if process.poll() is not None or time.monotonic() > until:
                        log.seek(0)
                        say(log.read().decode())
                        raise
                    time.sleep(0.05)
            yield process.pid
        finally:
            process.kill()
            process.wait()


# limit


def limit(seconds: float) -> None:
    kinds = {"asyncio": "gateway, asyncio", "uvloop": "gateway, uvloop"}
    kinds |= {"pymodbus-async": "pymodbus, async client", "pymodbus-sync": "pymodbus, sync client"}
    if not find_spec("uvloop"):
        del kinds["uvloop"]
    rows = []
    for kind, name in kinds.items():
        with simulated(["line=1"]) as (folder, simulator):
            command = [sys.executable, str(HERE / "line_clients.py"), kind, str(folder / "line"), str(seconds)]
            done = subprocess.run(
                command, check=True, capture_output=True, env=ENVIRONMENT, preexec_fn=first
            )  # nothing else runs here
            seen = simulator.seen()[0]
        found = json.loads(done.stdout)
        per_read_s = found["seconds"] / found["reads"]
        rows.append(
            (
                name,
                f"{per_read_s * 1000:.2f}",
                f"{READ_S / per_read_s:.1%}",
                f"{READ_S / found['median_s']:.1%}",
                f"{seen['gap_violations']:.0f} of {seen['requests'] - 1:.0f}",
                f"{seen['shortest_gap_s'] * 1000:.2f}",
                f"{found['cpu_s'] / found['reads'] * 1000:.2f}",
            )
        )
    say(f"\n82 registers at 9600 8N2, {seconds:g} s each; the limit is {READ_S * 1000:.2f} ms a read\n")
    head = (
        "client",
        "ms a read",
        "of the limit",
        "median read",
        "gaps under 3.5 characters",
        "shortest gap ms",
        "CPU ms a read",
    )
    say(table(head, rows))


# clients, dead, faults


@dataclass(frozen=True)
class Load:
    """What the clients got, and how busy the line was."""

    replies_per_s: float
    p50_ms: float
    p95_ms: float
    p99_ms: float
    refusals: dict[str, int]
    timeouts: int
    wrong: int
    oldest_s: float
    line_use: float

    def row(self, name: str, peer: Load | None) -> tuple[str, ...]:
        refused = " ".join(f"{count}×{code}" for code, count in self.refusals.items())
        return (
            name,
            f"{self.replies_per_s:,.1f}",
            "" if peer is None else f"{self.replies_per_s / max(peer.replies_per_s, 1e-9):,.0f}",
            *(f"{value:,.2f}" for value in (self.p50_ms, self.p95_ms, self.p99_ms)),
            refused or "0",
            str(self.timeouts),
            str(self.wrong),
            f"{self.oldest_s:.2f}",
            f"{self.line_use:.1%}",
        )


HEAD = (
    "server",
    "replies/s",
    "× bridge",
    "p50 ms",
    "p95 ms",
    "p99 ms",
    "refused",
    "timed out",
    "wrong",
    "oldest s",
    "line in use",
)


def load(generator: str, port: int, seconds: float, simulator: Simulator) -> Load:
    """One run of the load generator."""
    command = [generator, str(port), str(CLIENTS), str(seconds), str(DEVICES), str(PATIENCE_S)]
    simulator.begin()
    found = json.loads(subprocess.run(command, check=True, capture_output=True).stdout)
    seen = simulator.seen()[0]
    return Load(
        replies_per_s=found["replies"] / found["seconds"],
        p50_ms=found["p50_us"] / 1000,
        p95_ms=found["p95_us"] / 1000,
        p99_ms=found["p99_us"] / 1000,
        refusals=found["refusals"],
        timeouts=found["timeouts"],
        wrong=found["wrong"],
        oldest_s=found["oldest_ms"] / 1000,
        line_use=seen["use"],
    )


def configuration(folder: Path, modbus: int, http: int) -> Path:
    text = 'site = "bench"\n' + f'state_dir = "{folder}"\n'
    text += f'[[line]]\nname = "line"\nport = "{folder / "line"}"\n'
    for number in range(1, DEVICES + 1):
        text += f'[[line.device]]\nname = "array-{number}"\naddress = {number}\nunit_id = {number}\n'
        text += 'model = "prostar-mppt"\n'
    text += f"[cache]\nmax_age_s = {MAX_AGE_S}\n"
    text += f'[modbus]\nlisten = ["127.0.0.1:{modbus}"]\n[modbus.rate]\n'
    text += "".join(f"{key} = 0.0\n" for key in ("requests_per_s", "client_line_per_s", "device_per_s", "line_per_s"))
    text += f'[http]\nlisten = ["127.0.0.1:{http}"]\n[snmp]\nlisten = []\n'
    path = folder / "bench.toml"
    path.write_text(text)
    return path


def gateway(generator: str, seconds: float, plan: str, online: int, chaos_percent: float = 0.0) -> Load:
    with simulated([plan], chaos_percent=chaos_percent) as (folder, simulator):
        modbus, http = free_port(), free_port()
        command = [sys.executable, "-m", "gateway", "run", "-c", str(configuration(folder, modbus, http))]
        with running(command, modbus, ENVIRONMENT):
            until = time.monotonic() + START_S
            while time.monotonic() < until:
                with urllib.request.urlopen(f"http://127.0.0.1:{http}/metrics", timeout=5) as reply:
                    up = sum(row.startswith(b"morningstar_up{") and row.endswith(b" 1.0\n") for row in reply)
                if up >= online:
                    break
                time.sleep(0.2)
            time.sleep(5.0)  # settings and identification are read once
            return load(generator, modbus, seconds, simulator)


def bridge(generator: str, seconds: float, plan: str, proxy: Path | None = None, chaos_percent: float = 0.0) -> Load:
    """The bridge made of pymodbus, behind modbus-proxy when `proxy` says where that is installed."""
    with simulated([plan], chaos_percent=chaos_percent) as (folder, simulator), contextlib.ExitStack() as stack:
        port = free_port()
        command = [sys.executable, str(HERE / "pymodbus_bridge.py"), str(port), str(folder / "line")]
        stack.enter_context(running(command, port, ENVIRONMENT))
        if proxy is not None:
            upstream, port = port, free_port()
            urls = ("-b", f"tcp://127.0.0.1:{port}", "--modbus", f"tcp://127.0.0.1:{upstream}", "--timeout", "10")
            command = [sys.executable, "-m", "modbus_proxy", *urls]
            stack.enter_context(running(command, port, {**os.environ, "PYTHONPATH": str(proxy)}))
        return load(generator, port, seconds, simulator)


@contextlib.contextmanager
def modbus_proxy() -> Iterator[Path | None]:
    """Where modbus-proxy is installed for the time of the block; None when it cannot be had."""
    with tempfile.TemporaryDirectory(prefix="bench-") as name:
        pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "install", "--quiet", "--no-deps"]
        done = subprocess.run([*pip, "--target", name, MODBUS_PROXY], capture_output=True, check=False)
        if done.returncode:
            say(f"left out: {MODBUS_PROXY} cannot be installed")
        yield Path(name) if done.returncode == 0 else None


def clients(generator: str, seconds: float) -> None:
    plan = f"line=1-{DEVICES}"
    peer = bridge(generator, 2 * seconds, plan)
    rows = [gateway(generator, seconds, plan, DEVICES).row("gateway", peer), peer.row("pymodbus bridge", peer)]
    with modbus_proxy() as proxy:
        if proxy is not None:
            rows.append(bridge(generator, 2 * seconds, plan, proxy).row("modbus-proxy, then the bridge", peer))
    say(f"\n{CLIENTS} clients, {DEVICES} controllers on one line, 80 registers; max_age_s = {MAX_AGE_S:g}\n")
    say(table(HEAD, rows))
    say("\nmbusd is not in Debian and was not measured.")


def dead(generator: str, seconds: float) -> None:
    alive = DEVICES - 1
    plan = f"line=1-{alive},!{DEVICES}"
    peer = bridge(generator, 2 * seconds, plan)
    rows = [gateway(generator, seconds, plan, alive).row("gateway", peer), peer.row("pymodbus bridge", peer)]
    say(f"\nThe same with controller {DEVICES} dead; percentiles are of the good replies, so of the others\n")
    say(table(HEAD, rows))


def faults(generator: str, seconds: float) -> None:
    plan = f"line=1-{DEVICES}"
    peer = bridge(generator, 2 * seconds, plan, chaos_percent=2.0)
    found = gateway(generator, 2 * seconds, plan, DEVICES // 2, chaos_percent=2.0)
    say("\nThe same with 2 % of each kind of fault: lost, late, doubled, cut, spoilt, foreign, noise, echo, silence\n")
    say(table(HEAD, [found.row("gateway", peer), peer.row("pymodbus bridge", peer)]))


# growth


def shares(devices: int, lines: int) -> list[int]:
    """How many devices each line has."""
    return [devices // lines + (number < devices % lines) for number in range(lines)]


def real_growth(seconds: float) -> None:
    rows = []
    for devices, lines in GROWTH:
        share = shares(devices, lines)
        plans = [f"line{number}=1-{count}" for number, count in enumerate(share)]
        with simulated(plans, baudrate=115200) as (folder, simulator):
            period_s = 2 * devices / POLLS_PER_S  # two live blocks a device
            whole_s = period_s * math.ceil(seconds / period_s)  # polls of many devices come in bursts
            command = [sys.executable, str(HERE / "line_growth.py"), str(folder), str(period_s), str(whole_s)]
            done = subprocess.run([*command, *map(str, share)], check=True, capture_output=True, env=ENVIRONMENT)
            violations = sum(line["gap_violations"] for line in simulator.seen())
        found = json.loads(done.stdout)
        polls_per_s, cpu_ms = found["polls"] / found["seconds"], found["cpu_s"] / found["polls"] * 1000
        figures = (f"{polls_per_s:.1f}", f"{cpu_ms:.2f}", f"{found['rss_mib']:.0f}", f"{violations:.0f}")
        rows.append((str(devices), str(lines), *figures))
    say(f"\nGrowth, real ptys at 115200 baud, about {POLLS_PER_S:g} polls/s in sum, lines only (no face)\n")
    say(table(("controllers", "lines", "polls/s", "CPU ms a poll", "MiB", "gaps under 3.5 characters"), rows))


def virtual_growth(polls: int) -> None:
    """The engine's own part, without a kernel between: lines in virtual time that are busy all the time."""
    devices_map = load_map("prostar-mppt")
    runs: list[list[float]] = [[] for _ in GROWTH]
    for _ in range(ROUNDS):
        for run, (devices, lines) in zip(runs, GROWTH, strict=True):
            busy = [
                make_line(
                    *(OracleController(devices_map, address=address + 1, turnaround_s=0.0) for address in range(count)),
                    poll=PollSettings(live_s=0.01),
                )
                for count in shares(devices, lines)
            ]
            for line in busy:
                line.run(2.0 * len(line.devices))
            before, used = sum(line.engine.stats.polls for line in busy), time.process_time()
            for line in busy:
                line.run(polls / lines * READ_S / 2)
            run.append((time.process_time() - used) / (sum(line.engine.stats.polls for line in busy) - before) * 1e6)
    medians = [statistics.median(run) for run in runs]
    rows = [
        (str(devices), str(lines), f"{cpu_us:.0f}", f"{cpu_us / medians[0]:.2f}")
        for (devices, lines), cpu_us in zip(GROWTH, medians, strict=True)
    ]
    say("\nGrowth, engine and simulated controllers in virtual time, all lines saturated\n")
    say(table(("controllers", "lines", "CPU µs a poll", "÷ first"), rows))


PARTS = ("limit", "clients", "dead", "faults", "growth")


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS)
    parser.add_argument("--seconds", type=float, default=10.0)
    options = parser.parse_args()
    if shutil.which("gcc") is None:
        sys.exit("this benchmark needs gcc")
    say(f"\n{where()}")
    with tempfile.TemporaryDirectory(prefix="bench-") as folder:
        generator = str(Path(folder) / "line_load")
        subprocess.run(["gcc", "-O2", "-Wall", "-o", generator, str(HERE / "line_load.c")], check=True)
        for part in options.parts:
            if part == "limit":
                limit(options.seconds)
            elif part == "growth":
                real_growth(options.seconds)
                virtual_growth(VIRTUAL_POLLS)
            else:
                {"clients": clients, "dead": dead, "faults": faults}[part](generator, options.seconds)


if __name__ == "__main__":
    main()
