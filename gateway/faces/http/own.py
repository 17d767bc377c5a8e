"""The gateway's own metrics: what it is, what its lines and its faces did.

Each metric is one rule: its description and how it is read from its source. `OWN_METRICS` lists the
descriptions for the documentation. Sources are counters in memory; nothing here waits.
"""

from __future__ import annotations

import platform
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Generic, TypeVar

from prometheus_client.metrics_core import Metric

from gateway import __version__
from gateway.clock import Clock
from gateway.core.site import Device, LinePort, LineState, LineStatus, Site
from gateway.core.stats import ModbusServerStats
from gateway.faces.http.devices import DEVICE_LABELS, device_labels
from gateway.faces.http.metric import MetricInfo, Sample, counter, gauge

T = TypeVar("T")

LINE_LABELS = ("site", "line")

ERROR_KINDS = ("timeout", "crc", "mismatch", "exception")
"""Kinds of failed line requests that have a series from the start, so that the first failure is a rise."""


@dataclass(slots=True)
class HttpStats:
    """The HTTP face since start."""

    connections: int = 0
    closed_for_room: int = 0
    scrapes: int = 0
    scrape_s: float = 0.0


@dataclass(frozen=True, slots=True)
class LineView:
    """A line at the moment of a scrape."""

    port: LinePort
    status: LineStatus


@dataclass(frozen=True, slots=True)
class GatewayView:
    """The process."""

    started_at: float  # wall clock


@dataclass(frozen=True, slots=True)
class Rule(Generic[T]):
    """A metric and how it is read: label values beyond those of the source, and the number."""

    metric: MetricInfo
    read: Callable[[T], Iterable[Sample]]


def _one(metric: MetricInfo, pick: Callable[[T], float]) -> Rule[T]:
    return Rule(metric, lambda source: (((), float(pick(source))),))


def _each(metric: MetricInfo, pick: Callable[[T], Mapping[str, int]]) -> Rule[T]:
    return Rule(metric, lambda source: [((key,), float(count)) for key, count in sorted(pick(source).items())])


def _gateway_gauge(name: str, help_text: str, *labels: str) -> MetricInfo:
    return gauge(f"prostar_gateway_{name}", help_text, *labels)


def _gateway_counter(name: str, help_text: str, *labels: str) -> MetricInfo:
    return counter(f"prostar_gateway_{name}_total", help_text, *labels)


def _line_gauge(name: str, help_text: str) -> MetricInfo:
    return _gateway_gauge(f"line_{name}", help_text, *LINE_LABELS)


def _line_counter(name: str, help_text: str, *labels: str) -> MetricInfo:
    return _gateway_counter(f"line_{name}", help_text, *LINE_LABELS, *labels)


def _device_counter(name: str, help_text: str) -> MetricInfo:
    return _gateway_counter(f"device_{name}", help_text, *DEVICE_LABELS)


def _line_errors(view: LineView) -> Mapping[str, int]:
    return dict.fromkeys(ERROR_KINDS, 0) | view.port.stats.failed


def _wire_bytes(view: LineView) -> Mapping[str, int]:
    wire = view.port.stats.wire
    return {"noise": wire.noise_bytes, "late": wire.late_bytes}


def _wire_frames(view: LineView) -> Mapping[str, int]:
    wire = view.port.stats.wire
    return {
        "wrong_unit": wire.wrong_unit,
        "mismatch": wire.mismatch,
        "crc_error": wire.crc_errors,
        "echo": wire.echoes,
    }


GATEWAY_RULES: tuple[Rule[GatewayView], ...] = (
    Rule(
        _gateway_gauge("build_info", "Version of the gateway and of Python, always 1.", "version", "python"),
        lambda _: (((__version__, platform.python_version()), 1.0),),
    ),
    _one(_gateway_gauge("start_time_seconds", "When the gateway started, Unix time."), lambda view: view.started_at),
)

LINE_RULES: tuple[Rule[LineView], ...] = (
    _one(_line_gauge("up", "1 while the port is open."), lambda view: view.status.state is LineState.OPEN),
    _one(
        _line_gauge("use_ratio", "Share of the last minute in which the line was occupied, 0 to 1."),
        lambda view: view.status.use_ratio,
    ),
    _one(_line_gauge("queue_depth", "Reads of clients that wait for the line."), lambda view: view.status.queue_depth),
    _one(_line_counter("requests", "Requests sent on the line."), lambda view: view.port.stats.sent),
    _one(_line_counter("replies", "Requests that ended with a good reply."), lambda view: view.port.stats.ok),
    _each(_line_counter("errors", "Requests that ended otherwise, by kind.", "kind"), _line_errors),
    _one(_line_counter("retries", "Requests sent again."), lambda view: view.port.stats.retries),
    _one(_line_counter("polls", "Requests of the gateway's own polling."), lambda view: view.port.stats.polls),
    _one(_line_counter("client_reads", "Requests on behalf of clients."), lambda view: view.port.stats.client_reads),
    _one(_line_counter("opens", "How often the port was opened."), lambda view: view.port.stats.opens),
    _one(_line_counter("busy_seconds", "Time in which the line was occupied."), lambda view: view.port.stats.busy_s),
    _each(_line_counter("discarded_bytes", "Received bytes that were of no use, by kind.", "kind"), _wire_bytes),
    _each(_line_counter("discarded_frames", "Received frames that were of no use, by kind.", "kind"), _wire_frames),
)

DEVICE_RULES: tuple[Rule[Device], ...] = (
    _one(_device_counter("polls", "Polls of the controller."), lambda device: device.stats.polls),
    _one(_device_counter("poll_failures", "Polls that got no good reply."), lambda device: device.stats.failures),
    _one(_device_counter("exceptions", "Exception replies of the controller."), lambda device: device.stats.exceptions),
    _one(_device_counter("offline", "How often it went offline."), lambda device: device.stats.went_offline),
    _one(
        _device_counter("implausible", "Values that were withheld because they cannot be."),
        lambda device: device.stats.implausible,
    ),
)

MODBUS_RULES: tuple[Rule[ModbusServerStats], ...] = (
    _one(_gateway_gauge("modbus_connections", "Open Modbus TCP connections."), lambda stats: stats.open_connections),
    _one(
        _gateway_counter("modbus_connections_accepted", "Modbus TCP connections accepted."),
        lambda stats: stats.connections,
    ),
    _one(
        _gateway_counter("modbus_connections_refused", "Modbus TCP connections refused."),
        lambda stats: stats.refused_connections,
    ),
    _one(_gateway_counter("modbus_requests", "Modbus TCP requests."), lambda stats: stats.requests),
    _one(
        _gateway_counter("modbus_cache_hits", "Modbus TCP requests answered from memory."),
        lambda stats: stats.cache_hits,
    ),
    _one(
        _gateway_counter("modbus_forwarded", "Modbus TCP requests that were sent to a line."),
        lambda stats: stats.forwarded,
    ),
    _each(
        _gateway_counter("modbus_exceptions", "Exception replies to clients, by exception code (hexadecimal).", "code"),
        lambda stats: {f"{code:02X}": count for code, count in stats.exceptions.items()},
    ),
    _each(
        _gateway_counter("modbus_requests_refused", "Modbus TCP requests refused by policy, by reason.", "reason"),
        lambda stats: stats.refused,
    ),
    _each(
        _gateway_counter("modbus_connections_closed", "Modbus TCP connections the server ended, by reason.", "reason"),
        lambda stats: stats.closed,
    ),
    _each(
        _gateway_counter("modbus_malformed", "Input that is no Modbus TCP, by reason.", "reason"),
        lambda stats: stats.malformed,
    ),
)

SNMP_RULES: tuple[Rule[Mapping[str, int]], ...] = (
    _each(_gateway_counter("snmp_events", "What the SNMP face counted, by event.", "event"), lambda stats: stats),
)

HTTP_RULES: tuple[Rule[HttpStats], ...] = (
    _one(_gateway_counter("http_connections_accepted", "HTTP connections accepted."), lambda stats: stats.connections),
    _one(
        _gateway_counter("http_connections_closed_for_room", "Idle HTTP connections closed to let another one in."),
        lambda stats: stats.closed_for_room,
    ),
    _one(_gateway_counter("scrapes", "Scrapes answered before this one."), lambda stats: stats.scrapes),
    _one(_gateway_counter("scrape_seconds", "Time spent on making the replies to them."), lambda stats: stats.scrape_s),
)

OWN_METRICS: tuple[MetricInfo, ...] = tuple(
    rule.metric
    for rules in (GATEWAY_RULES, LINE_RULES, DEVICE_RULES, MODBUS_RULES, SNMP_RULES, HTTP_RULES)
    for rule in rules
)
"""Every `prostar_gateway_*` metric; `process_*` and `python_gc_*` come from prometheus-client as they are."""


def _no_events() -> Mapping[str, int]:
    return {}


@dataclass(frozen=True, slots=True)
class Counts:
    """Where the counters of the faces are."""

    modbus: ModbusServerStats = field(default_factory=ModbusServerStats)
    snmp: Callable[[], Mapping[str, int]] = _no_events
    http: HttpStats = field(default_factory=HttpStats)


class OwnCollector:
    """Collects the gateway's own metrics."""

    def __init__(self, site: Site, clock: Clock, counts: Counts) -> None:
        self._site = site
        self._clock = clock
        self._counts = counts
        self._gateway = GatewayView(clock.wall())
        self._devices = [(device, device_labels(site, device)) for device in site.devices]

    def collect(self) -> Iterator[Metric]:
        """All of them, each line and counter read once."""
        now = self._clock.monotonic()
        lines = [(LineView(line, line.status(now)), (self._site.name, line.name)) for line in self._site.lines]
        yield from _families(GATEWAY_RULES, [(self._gateway, ())])
        yield from _families(LINE_RULES, lines)
        yield from _families(DEVICE_RULES, self._devices)
        yield from _families(MODBUS_RULES, [(self._counts.modbus, ())])
        yield from _families(SNMP_RULES, [(self._counts.snmp(), ())])
        yield from _families(HTTP_RULES, [(self._counts.http, ())])


def _families(rules: Iterable[Rule[T]], sources: Sequence[tuple[T, tuple[str, ...]]]) -> Iterator[Metric]:
    for rule in rules:
        yield rule.metric.family(
            ((*labels, *extra), value) for source, labels in sources for extra, value in rule.read(source)
        )
