"""The gateway's own metrics of its lines and of what it asked each controller: where the time of a line goes.

Kinds that can be named beforehand have a series from the start, so that the first failure is a rise.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from gateway.core.requests import Purpose
from gateway.core.site import Device, LinePort, LineState, LineStatus
from gateway.faces.http.devices import DEVICE_LABELS
from gateway.faces.http.metric import MetricInfo
from gateway.faces.http.rules import (
    Rule,
    each,
    gateway_counter,
    gateway_gauge,
    gateway_histogram,
    known,
    one,
    times,
)

LINE_LABELS = ("line", "site")

_ECHO = {"present": 1.0, "absent": 0.0}

ERROR_KINDS = ("timeout", "crc", "mismatch", "exception")
CONNECTION_ENDS = ("finished", "closed", "timeout")


@dataclass(frozen=True, slots=True)
class LineView:
    """A line at the moment of a scrape."""

    port: LinePort
    status: LineStatus


def _line_gauge(name: str, help_text: str) -> MetricInfo:
    return gateway_gauge(f"line_{name}", help_text, *LINE_LABELS)


def _line_counter(name: str, help_text: str, *labels: str) -> MetricInfo:
    return gateway_counter(f"line_{name}", help_text, *LINE_LABELS, *labels)


def _line_histogram(name: str, help_text: str) -> MetricInfo:
    return gateway_histogram(f"line_{name}", help_text, *LINE_LABELS)


def _device_counter(name: str, help_text: str, *labels: str) -> MetricInfo:
    return gateway_counter(f"device_{name}", help_text, *DEVICE_LABELS, *labels)


def _line_errors(view: LineView) -> Mapping[str, int]:
    return dict.fromkeys(ERROR_KINDS, 0) | view.port.stats.failed


def _purposes(view: LineView) -> Mapping[str, float]:
    return dict.fromkeys((purpose.value for purpose in Purpose), 0.0) | view.port.stats.seconds_by_purpose


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


def _connections(view: LineView) -> Mapping[str, int]:
    upstream = view.port.stats.upstream
    return {} if upstream is None else dict.fromkeys(CONNECTION_ENDS, 0) | upstream.lost


def _device_errors(device: Device) -> Mapping[str, int]:
    return dict.fromkeys(ERROR_KINDS, 0) | device.stats.errors


LINE_RULES: tuple[Rule[LineView], ...] = (
    one(_line_gauge("up", "1 while the port is open."), lambda view: view.status.state is LineState.OPEN),
    one(
        _line_gauge("use_ratio", "Share of the last minute in which the line was occupied, 0 to 1."),
        lambda view: view.status.use_ratio,
    ),
    one(
        _line_gauge("stretch_ratio", "How much longer live values take than was asked for; 1 while the line keeps up."),
        lambda view: view.status.stretch,
    ),
    known(
        _line_gauge("echo", "1 while the line gives our own requests back, 0 while not; absent until that is known."),
        lambda view: _ECHO.get(view.status.echo),
    ),
    one(_line_gauge("queue_depth", "Reads of clients that wait for the line."), lambda view: view.status.queue_depth),
    one(_line_counter("requests", "Requests sent on the line."), lambda view: view.port.stats.sent),
    one(_line_counter("replies", "Requests that ended with a good reply."), lambda view: view.port.stats.ok),
    each(_line_counter("errors", "Requests that ended otherwise, by kind.", "kind"), _line_errors),
    one(_line_counter("retries", "Requests sent again."), lambda view: view.port.stats.retries),
    one(_line_counter("polls", "Requests of the gateway's own polling."), lambda view: view.port.stats.polls),
    one(_line_counter("client_reads", "Requests on behalf of clients."), lambda view: view.port.stats.client_reads),
    one(
        _line_counter("joined_reads", "Reads of clients that were answered by another's request."),
        lambda view: view.port.stats.joined,
    ),
    one(_line_counter("writes", "Writes sent on the line."), lambda view: view.port.stats.writes),
    one(_line_counter("opens", "How often the port was opened."), lambda view: view.port.stats.opens),
    one(_line_counter("busy_seconds", "Time in which the line was occupied."), lambda view: view.port.stats.busy_s),
    each(
        _line_counter("purpose_seconds", "Time in which the line was occupied, by what for.", "purpose"),
        _purposes,
    ),
    each(
        _line_counter("client_seconds", "Time in which the line was occupied for clients, by client.", "client"),
        lambda view: view.port.stats.seconds_by_client,
    ),
    times(
        _line_histogram("queue_wait_seconds", "How long reads and writes of clients waited for the line."),
        lambda view: view.port.stats.queue_wait,
    ),
    times(
        _line_histogram("reply_seconds", "From sending a request to its whole reply."),
        lambda view: view.port.stats.reply_time,
    ),
    known(
        _line_counter("connections", "Connections made to a Modbus TCP upstream."),
        lambda view: None if view.port.stats.upstream is None else view.port.stats.upstream.connections,
    ),
    known(
        _line_counter("connections_refused", "Attempts that gave no connection to the upstream."),
        lambda view: None if view.port.stats.upstream is None else view.port.stats.upstream.refused,
    ),
    each(
        _line_counter("connections_ended", "Connections to the upstream that ended, by why.", "reason"),
        _connections,
    ),
    known(
        _line_gauge("window", "How many requests the upstream is given at once, as learnt."),
        lambda view: None if view.port.stats.upstream is None else view.port.stats.upstream.window,
    ),
    each(_line_counter("discarded_bytes", "Received bytes that were of no use, by kind.", "kind"), _wire_bytes),
    each(_line_counter("discarded_frames", "Received frames that were of no use, by kind.", "kind"), _wire_frames),
)

DEVICE_RULES: tuple[Rule[Device], ...] = (
    one(_device_counter("polls", "Polls of the controller."), lambda device: device.stats.polls),
    one(_device_counter("poll_failures", "Polls that got no good reply."), lambda device: device.stats.failures),
    one(_device_counter("exceptions", "Exception replies of the controller."), lambda device: device.stats.exceptions),
    each(
        _device_counter("errors", "Requests to the controller that got no good reply, by kind.", "kind"),
        _device_errors,
    ),
    one(
        _device_counter("line_seconds", "Time in which the line was occupied with the controller."),
        lambda device: device.stats.line_s,
    ),
    known(
        gateway_gauge(
            "device_refresh_seconds",
            "How often its live values were read of late; absent until known.",
            *DEVICE_LABELS,
        ),
        lambda device: device.stats.refresh_s,
    ),
    one(_device_counter("offline", "How often it went offline."), lambda device: device.stats.went_offline),
    one(
        _device_counter("implausible", "Values that were withheld because they cannot be."),
        lambda device: device.stats.implausible,
    ),
    one(
        _device_counter("identity_mismatches", "How often another unit than the expected one answered."),
        lambda device: device.stats.identity_mismatches,
    ),
)
