"""A Modbus TCP upstream: the gateway against modbus-proxy (PyPI), 16 clients × 4 units, nothing of it in memory.

    .venv/bin/python tests/bench/bench_upstream.py [--rounds 3] [--seconds 3] [--loads keeps:0 closes:5]

A load is what the server does after a reply and its latency in milliseconds. Every client reads ten registers from an
address at random, outside of what is polled, so that each read has to be asked of the server. Servers run one after
the other in every round; ratios are taken within a round and their median is shown.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parents[1]))

from tests.bench.bench_line import ENVIRONMENT, cpu_s, free_port, modbus_proxy, running, say, table, where  # noqa: E402

CLIENTS = 16
UNITS = (1, 2, 3, 4)
GATEWAY_UNITS = (11, 12, 13, 14)
TUNED = {"keeps": "pipelining = 32\n", "closes": "connections = 8\n"}
"""What a user would set for a converter or gateway that serves many; both are the most that is allowed."""
LOADS = ("keeps:0", "keeps:5", "closes:0", "closes:5")
HEAD = ("server", "replies/s", "× modbus-proxy", "p50 ms", "p99 ms", "CPU µs a reply", "refused", "timed out", "wrong")


@dataclass(frozen=True)
class Load:
    """How the server behind behaves."""

    habit: str
    latency_ms: float

    @classmethod
    def of(cls, text: str) -> Load:
        """From `HABIT:MILLISECONDS`."""
        habit, _, latency = text.partition(":")
        return cls(habit, float(latency))

    @property
    def title(self) -> str:
        what = "keeps its connections" if self.habit == "keeps" else "closes after every reply"
        return f"The server {what} and answers after {self.latency_ms:g} ms"


@dataclass(frozen=True)
class Run:
    """What the clients saw in one round."""

    rate: float
    p50_ms: float
    p99_ms: float
    errors: int
    timed_out: int
    wrong: int
    cpu_us: float = 0.0  # of the server in between, a reply


def config(folder: Path, upstream: int, port: int, habit: str = "keeps") -> Path:
    text = f'site = "bench"\nstate_dir = "{folder}"\n[[line]]\nname = "far"\nport = "tcp://127.0.0.1:{upstream}"\n'
    text += "reply_timeout_s = 3.0\n" + TUNED[habit]
    for unit, address in zip(GATEWAY_UNITS, UNITS, strict=True):
        text += (
            f'[[line.device]]\nname = "array-{unit}"\naddress = {address}\nunit_id = {unit}\nmodel = "prostar-mppt"\n'
        )
    text += "[poll]\nlive_s = 3600.0\nsettings_s = 3600.0\n[cache]\nmax_age_s = 0.1\n[history]\nenabled = false\n"
    text += f'[modbus]\nlisten = ["127.0.0.1:{port}"]\n[modbus.rate]\n'
    text += "".join(f"{key} = 0.0\n" for key in ("requests_per_s", "client_line_per_s", "device_per_s", "line_per_s"))
    text += "[snmp]\nlisten = []\n[http]\nlisten = []\n"
    path = folder / "bench.toml"
    path.write_text(text)
    return path


def load(port: int, seconds: float, units: tuple[int, ...]) -> Run:
    command = [
        sys.executable,
        "-m",
        "tests.bench.upstream_load",
        str(port),
        str(CLIENTS),
        str(seconds),
        *map(str, units),
    ]
    done = subprocess.run(command, cwd=HERE.parents[1], env=ENVIRONMENT, capture_output=True, text=True, check=True)
    return Run(**json.loads(done.stdout))


def loaded(pid: int, port: int, seconds: float, units: tuple[int, ...]) -> Run:
    """With the CPU time of that process."""
    before_s = cpu_s(pid)
    run = load(port, seconds, units)
    return replace(run, cpu_us=1e6 * (cpu_s(pid) - before_s) / max(1.0, run.rate * seconds))


@contextlib.contextmanager
def upstream(how: Load) -> Iterator[int]:
    port = free_port()
    command = [sys.executable, "-m", "tests.bench.upstream_server", str(port), str(how.latency_ms), how.habit]
    with running(command, port, ENVIRONMENT):
        yield port


def gateway(how: Load, seconds: float) -> Run:
    with tempfile.TemporaryDirectory(prefix="bench-") as name, upstream(how) as behind:
        port = free_port()
        command = [sys.executable, "-m", "gateway", "run", "-c", str(config(Path(name), behind, port, how.habit))]
        with running(command, port, ENVIRONMENT) as pid:
            load(port, 1.0, GATEWAY_UNITS)  # what the server stands is learnt, and everything is identified
            return loaded(pid, port, seconds, GATEWAY_UNITS)


def proxy(where: Path) -> Callable[[Load, float], Run]:
    def run(how: Load, seconds: float) -> Run:
        with upstream(how) as behind:
            port = free_port()
            urls = ("-b", f"tcp://127.0.0.1:{port}", "--modbus", f"tcp://127.0.0.1:{behind}", "--timeout", "10")
            environment = {**os.environ, "PYTHONPATH": str(where)}
            with running([sys.executable, "-m", "modbus_proxy", *urls], port, environment) as pid:
                load(port, 1.0, UNITS)
                return loaded(pid, port, seconds, UNITS)

    return run


def itself(how: Load, seconds: float) -> Run:
    with upstream(how) as port:
        return load(port, seconds, UNITS)


def measure(loads: list[Load], rounds: int, seconds: float) -> None:
    with modbus_proxy() as installed:
        servers: dict[str, Callable[[Load, float], Run]] = {"gateway": gateway}
        if installed is not None:
            servers["modbus-proxy"] = proxy(installed)
        for how in loads:
            seen: dict[str, list[Run]] = {name: [] for name in servers}
            if how.habit == "keeps":
                seen["the server itself"] = []
            for _ in range(rounds):
                for name, runs in seen.items():
                    runs.append(servers.get(name, itself)(how, seconds))
            say(f"\n{how.title}; {CLIENTS} clients, {len(UNITS)} units, 10 registers a read\n")
            say(table(HEAD, [row(name, runs, seen.get("modbus-proxy")) for name, runs in seen.items()]))


def row(name: str, runs: list[Run], peers: list[Run] | None) -> tuple[str, ...]:
    ratio = "–"
    if peers is not None:
        ratio = f"{statistics.median(one.rate / peer.rate for one, peer in zip(runs, peers, strict=True)):.1f}"
    return (
        name,
        f"{statistics.median(run.rate for run in runs):,.0f}",
        ratio,
        f"{statistics.median(run.p50_ms for run in runs):.2f}",
        f"{statistics.median(run.p99_ms for run in runs):.2f}",
        "–" if not runs[0].cpu_us else f"{statistics.median(run.cpu_us for run in runs):.0f}",
        str(sum(run.errors for run in runs)),
        str(sum(run.timed_out for run in runs)),
        str(sum(run.wrong for run in runs)),
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=3.0)
    parser.add_argument("--loads", nargs="+", type=Load.of, default=[Load.of(text) for text in LOADS])
    arguments = parser.parse_args()
    say(where())
    measure(arguments.loads, arguments.rounds, arguments.seconds)


if __name__ == "__main__":
    main()
