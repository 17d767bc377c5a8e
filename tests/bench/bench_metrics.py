"""What a scrape of 200 devices costs over HTTP: the gateway beside prometheus-client's own server.

    .venv/bin/python tests/bench/bench_metrics.py [--rounds 15]

Two sites: 200 devices of 80 measured values each, and 200 ProStars with all their states and bits. The servers are
processes of their own (metrics_server.py); each format is asked in turn within a round, so that ratios are of one
minute. Before each scrape all live values change, as polls change them; *unchanged* is a second scrape right after.
Time is from the request to the last byte read.
"""

from __future__ import annotations

import argparse
import http.client
import os
import platform
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path

HERE = Path(__file__).parent
OPENMETRICS = "application/openmetrics-text; version=1.0.0"
FORMATS = {
    "text": {"Accept-Encoding": "identity"},
    "OpenMetrics": {"Accept": OPENMETRICS, "Accept-Encoding": "identity"},
    "text, gzip": {"Accept-Encoding": "gzip"},
    "OpenMetrics, gzip": {"Accept": OPENMETRICS, "Accept-Encoding": "gzip"},
}
SITES = {"80": "200 devices × 80 measured values", "prostar": "200 ProStars, every state and bit"}
BAR = 15.0


class Server:
    """One server process."""

    def __init__(self, which: str, size: str) -> None:
        self._process = subprocess.Popen(
            [sys.executable, str(HERE / "metrics_server.py"), which, size],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            cwd=HERE.parents[1],
            env={**os.environ, "PYTHONPATH": str(HERE.parents[1])},
        )
        self.port = int(self._read())

    def tell(self, line: str) -> str:
        """Its answer to a command."""
        assert self._process.stdin is not None
        self._process.stdin.write(f"{line}\n")
        self._process.stdin.flush()
        return self._read()

    def scrape(self, headers: dict[str, str]) -> tuple[float, int]:
        """Milliseconds of one scrape, and bytes."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=60)
        began = time.perf_counter()
        connection.request("GET", "/metrics", headers=headers)
        body = connection.getresponse().read()
        took_ms = (time.perf_counter() - began) * 1000
        connection.close()
        return took_ms, len(body)

    def stop(self) -> None:
        """End it."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait(10)
        assert self._process.stdout is not None
        self._process.stdout.close()

    def _read(self) -> str:
        assert self._process.stdout is not None
        return self._process.stdout.readline().strip()


@contextmanager
def both(size: str) -> Iterator[tuple[Server, Server]]:
    """The gateway and its peer over the same site."""
    gateway, peer = Server("gateway", size), Server("peer", size)
    try:
        yield gateway, peer
    finally:
        gateway.stop()
        peer.stop()


def say(text: str) -> None:
    """Print a line of the report."""
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


def measure(size: str, rounds: int) -> None:
    """Print the table of one site."""
    taken: dict[str, list[tuple[float, float, float, float]]] = {form: [] for form in FORMATS}
    kilobytes: dict[str, float] = {}
    with both(size) as (gateway, peer):
        for headers in FORMATS.values():  # the first scrape writes every line; it is made once after a start
            gateway.scrape(headers)
        for _ in range(rounds):
            for form, headers in FORMATS.items():
                peer.tell("change")
                gateway.tell("change")
                gateway.tell("held")
                theirs, _ = peer.scrape(headers)
                changed, size_b = gateway.scrape(headers)
                held = float(gateway.tell("held"))
                unchanged, _ = gateway.scrape(headers)
                taken[form].append((theirs, changed, unchanged, held))
                kilobytes[form] = size_b / 1000
        text = http_text(gateway)
    series = sum(1 for line in text.splitlines() if line and not line.startswith("#"))
    say(f"\n{SITES[size]}: {series:,} series\n")
    say("| format | prometheus-client ms | gateway ms | ÷ | unchanged ms | loop held at most ms | kB |")
    say("|---|---|---|---|---|---|---|")
    for form, runs in taken.items():
        theirs, changed, unchanged, held = (statistics.median(column) for column in zip(*runs, strict=True))
        ratio = statistics.median(run[0] / run[1] for run in runs)
        mark = "" if ratio >= BAR else f" (bar: {BAR:.0f})"
        say(
            f"| {form} | {theirs:.0f} | {changed:.1f} | {ratio:.0f}{mark} | {unchanged:.1f} | {held:.1f} "
            f"| {kilobytes[form]:,.0f} |"
        )


def http_text(server: Server) -> str:
    """A whole reply as text."""
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=60)
    connection.request("GET", "/metrics", headers=FORMATS["text"])
    text = connection.getresponse().read().decode()
    connection.close()
    return text


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--rounds", type=int, default=9)
    rounds = parser.parse_args().rounds
    load = os.getloadavg()[0]
    say(
        f"## Metrics over HTTP\n\n{datetime.now(UTC):%Y-%m-%d}, {platform.machine()}, {os.cpu_count()} cores, "
        f"Linux {platform.release().split('-')[0]}, Python {platform.python_version()}; {rounds} rounds, "
        f"load average {load:.1f}; medians."
    )
    for size in SITES:
        measure(size, rounds)


if __name__ == "__main__":
    main()
