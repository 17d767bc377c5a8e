"""What is wrong now: metrics, and `/api/v1/conditions` for people and programs.

    GET /api/v1/conditions              what is raised
    GET /api/v1/conditions?state=all    everything that there is, clear and unknown too

The faults and alarms of a controller have a series each already (`morningstar_array_faults` and so on), so here they
are only counted.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping

from gateway.core.conditions import Conditions, ConditionState, DeviceConditions, Watch
from gateway.core.stats import NotifyStats
from gateway.faces.http.devices import DEVICE_LABELS
from gateway.faces.http.rules import Rule, Source, each, gateway_counter, gateway_gauge, known, one

PATH = "/api/v1/conditions"
WATCHES_A_PIECE = 32
"""Conditions that are looked at in one turn: a tenth of a millisecond, or two."""

GATEWAY_LABELS = ("condition", "line")
RECEIVER_LABELS = ("receiver", "kind")

DEVICE_CONDITION_RULES: tuple[Rule[DeviceConditions], ...] = (
    each(
        gateway_gauge(
            "conditions", "Conditions of a controller that are raised, by severity.", *DEVICE_LABELS, "severity"
        ),
        lambda of: {severity.name.lower(): count for severity, count in of.active.items()},
    ),
)

GATEWAY_CONDITION_RULES: tuple[Rule[Watch], ...] = (
    known(
        gateway_gauge(
            "condition",
            "1 while a condition of the gateway or one of its lines is raised; absent while nobody knows.",
            *GATEWAY_LABELS,
        ),
        lambda watch: None if watch.state is ConditionState.UNKNOWN else float(watch.state is ConditionState.RAISED),
    ),
)

NOTIFY_RULES: tuple[Rule[NotifyStats], ...] = (
    one(
        gateway_counter("snmp_notifications", "SNMP notifications to a receiver.", *RECEIVER_LABELS),
        lambda stats: stats.notifications,
    ),
    one(
        gateway_counter(
            "snmp_notifications_sent", "Datagrams with a notification; an inform may take several.", *RECEIVER_LABELS
        ),
        lambda stats: stats.sent,
    ),
    one(
        gateway_counter("snmp_notifications_repeated", "Of these, those that were sent before.", *RECEIVER_LABELS),
        lambda stats: stats.repeated,
    ),
    one(
        gateway_counter("snmp_notifications_acknowledged", "Informs that were acknowledged.", *RECEIVER_LABELS),
        lambda stats: stats.acknowledged,
    ),
    one(
        gateway_counter("snmp_notifications_failed", "Datagrams that the system did not take.", *RECEIVER_LABELS),
        lambda stats: stats.failures,
    ),
    each(
        gateway_counter(
            "snmp_notifications_refused",
            "Answers that say that it is not taken, by reason.",
            *RECEIVER_LABELS,
            "reason",
        ),
        lambda stats: stats.refused,
    ),
    one(
        gateway_gauge("snmp_notifications_waiting", "Notifications that wait or are under way.", *RECEIVER_LABELS),
        lambda stats: stats.waiting,
    ),
    one(
        gateway_gauge("snmp_receiver_silent", "1 while a receiver leaves informs unanswered.", *RECEIVER_LABELS),
        lambda stats: stats.silent,
    ),
)


def gateway_sources(conditions: Conditions) -> list[Source[Watch]]:
    """The conditions of the gateway and its lines as sources of metrics."""
    return [
        Source.labelled(watch, GATEWAY_LABELS, (watch.condition.name, "" if watch.line is None else watch.line.name))
        for watch in conditions.gateway
    ]


def receiver_source(stats: NotifyStats) -> Source[NotifyStats]:
    """A receiver as a source of metrics."""
    return Source.labelled(stats, RECEIVER_LABELS, (stats.receiver, stats.kind))


def wants_all(query: Mapping[str, str]) -> bool:
    """Whether everything is asked for; ValueError says what is wrong with the parameters."""
    unknown = [name for name in query if name != "state"]
    if unknown:
        raise ValueError(f"unknown parameter {unknown[0]!r}; allowed: state")
    state = query.get("state", "raised")
    if state not in {"raised", "all"}:
        raise ValueError(f"{state!r} is no state; allowed: raised, all")
    return state == "all"


def conditions_pieces(conditions: Conditions, now: float, *, everything: bool) -> Iterator[bytes]:
    """What `/api/v1/conditions` says, as JSON in pieces, some of which are empty.

    It is by unit id (0: the gateway and its lines) and code; seconds before now.
    """
    out = ['{"conditions": [']
    separator = ""
    for looked_at, watch in enumerate(tuple(conditions), 1):
        if everything or watch.state is ConditionState.RAISED:
            out += separator, json.dumps(_entry(watch, now))
            separator = ", "
        if looked_at % WATCHES_A_PIECE == 0:
            yield "".join(out).encode()
            out.clear()
    yield "".join([*out, "]}"]).encode()


def _entry(watch: Watch, now: float) -> dict[str, object]:
    return {
        "unit_id": watch.unit_id,
        "device": None if watch.device is None else watch.device.name,
        "line": _line(watch),
        "code": watch.condition.code,
        "condition": watch.condition.name,
        "text": watch.condition.text,
        "severity": watch.condition.severity.name.lower(),
        "state": watch.state.name.lower(),
        "changed_s_ago": round(max(0.0, now - watch.changed_at), 1),
        "times": watch.times,
    }


def _line(watch: Watch) -> str | None:
    line = watch.line if watch.device is None else watch.device.line
    return None if line is None else line.name
