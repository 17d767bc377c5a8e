"""Why /metrics is not served by prometheus-client's server, and our own collectors are not in its registry.

Each xfail says what should happen. It fails on prometheus-client 0.21 and newer; the day it passes, upstream was fixed.
"""

from __future__ import annotations

import contextlib
import socket
import threading
from collections.abc import Iterable, Iterator

import pytest
from prometheus_client import CollectorRegistry, start_http_server
from prometheus_client.core import GaugeMetricFamily
from prometheus_client.exposition import generate_latest
from prometheus_client.metrics_core import Metric
from prometheus_client.registry import Collector

IDLE = 20


def fails(why: str, raises: type[BaseException] = AssertionError) -> pytest.MarkDecorator:
    return pytest.mark.xfail(raises=raises, strict=True, reason=f"prometheus-client {why}")


class Voltage(Collector):
    """One series, or what comes instead."""

    def __init__(self, error: Exception | None = None) -> None:
        self.error = error

    def collect(self) -> Iterable[Metric]:
        """See `Collector`."""
        if self.error is not None:
            raise self.error
        yield GaugeMetricFamily("voltage", "of the battery", value=12.5)

    def describe(self) -> Iterable[Metric]:
        """Nothing, as for collectors whose series are not known beforehand."""
        return ()


class Up(Collector):
    """Another one."""

    def collect(self) -> Iterable[Metric]:
        """See `Collector`."""
        yield GaugeMetricFamily("up", "1", value=1)


def series(text: bytes) -> list[str]:
    return [line.split()[0] for line in text.decode().splitlines() if not line.startswith("#")]


def test_the_bench_is_sound() -> None:
    registry = CollectorRegistry()
    registry.register(Voltage())
    registry.register(Up())
    assert series(generate_latest(registry)) == ["voltage", "up"]


@fails("shows a series twice, upon which Prometheus takes nothing of the scrape")
def test_a_series_is_there_once() -> None:
    registry = CollectorRegistry()
    registry.register(Voltage())
    with contextlib.suppress(ValueError):
        registry.register(Voltage())
    assert series(generate_latest(registry)) == ["voltage"]


@fails("shows nothing where one collector fails", raises=ZeroDivisionError)
def test_a_collector_that_fails_takes_no_other_with_it() -> None:
    registry = CollectorRegistry()
    registry.register(Up())
    registry.register(Voltage(ZeroDivisionError("a bug")))
    assert series(generate_latest(registry)) == ["up"]


@pytest.fixture
def served() -> Iterator[int]:
    """The port of its own server."""
    server, thread = start_http_server(0, addr="127.0.0.1", registry=CollectorRegistry())
    yield server.server_port
    server.shutdown()
    server.server_close()
    thread.join()


@fails("has a thread for each connection, idle ones and half-sent requests too")
def test_idle_connections_cost_no_threads(served: int) -> None:
    before = threading.active_count()
    with contextlib.ExitStack() as stack:
        idle = [stack.enter_context(socket.create_connection(("127.0.0.1", served), timeout=60)) for _ in range(IDLE)]
        for one in idle:
            one.sendall(b"GET /metrics HT")
        last = stack.enter_context(socket.create_connection(("127.0.0.1", served), timeout=60))
        last.sendall(b"GET /metrics HTTP/1.0\r\n\r\n")
        assert last.recv(100).startswith(b"HTTP/1.")  # so the others were accepted before
        assert threading.active_count() - before < IDLE
