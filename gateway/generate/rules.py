"""Prometheus' recording and alert rules: those of every site, and one for each fault and alarm that a map names.

Rule 1: names of metrics, states and bits come from the maps and from the HTTP face, and severities of faults and
        alarms from the maps, so that a rule cannot wait for a series that nobody makes.
Rule 2: an alert stays while its cause does. What moves around a limit has two limits, further apart than the
        smallest step of a half-precision float.
Rule 3: battery limits are for a 12 V lead-acid battery. What makes them fit 24 and 48 V is the controller's own
        multiplier where it tells one, else the highest voltage that it has seen on its battery.
Rule 4: models that call a bit the same share its alert.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from gateway.core.snapshot import IDENTITY_MISMATCH, NOT_REWRITTEN, UNKNOWN_MODEL
from gateway.devices.agreement import all_maps
from gateway.devices.model import Bit, DeviceMap, Group, Point
from gateway.generate.yaml import Node, dump

FOLDER = "deploy/prometheus/rules"
JOB = "prostar-gateway"

BATTERY_LIMITS = {"Low": (11.9, 12.1, "warning", "10m"), "VeryLow": (11.6, 11.8, "critical", "5m")}
"""Name → volts of a 12 V battery below which it fires and above which it ends, severity, how long before it fires."""

LINE_SATURATED_RATIO = 0.95
FIELD_ERROR_RATIO = 1.5e-4
"""What was seen of failed requests on good lines in the field."""

LEAST_ERRORS = 10
"""So few failures in six hours are no rate."""

HIGHEST_VOLTS = {12: 20, 24: 40}
"""Nominal voltage → what its battery never reaches, and that of the next higher system does. 36 V counts as 48 V."""

DAYLIGHT_VOLTS = 2.0
"""By day the array is that much above the battery of a 12 V system, also when nothing flows."""

_WAIT = {"critical": "0s", "warning": "1m", "info": "5m"}
_PER_12V = "device:morningstar_battery_voltage_volts:per_12v"
_MULTIPLIER = "device:morningstar_battery_multiplier:ratio"
_ERRORS = "line:prostar_gateway_device_errors:increase6h"
_ERROR_RATIO = "line:prostar_gateway_device_errors:ratio6h"
_LINE = "job, instance, site, line"
_DEVICE = f"{_LINE}, device, unit_id, model"
_AT = "{{ $labels.device }} at {{ $labels.site }}"
_AT_LINE = "line {{ $labels.line }} at {{ $labels.site }}"


@dataclass(frozen=True, slots=True)
class Recording:
    """A series that is computed beforehand."""

    record: str
    expr: str

    def node(self) -> Mapping[str, Node]:
        """As Prometheus reads it."""
        return {"record": self.record, "expr": self.expr}


@dataclass(frozen=True, slots=True)
class Alert:
    """An alert: when, how long before it fires, how bad, and what is said."""

    name: str
    expr: str
    wait: str
    severity: str
    summary: str
    description: str

    def node(self) -> Mapping[str, Node]:
        """As Prometheus reads it."""
        return {
            "alert": self.name,
            "expr": self.expr,
            "for": self.wait,
            "labels": {"severity": self.severity},
            "annotations": {"summary": self.summary, "description": self.description},
        }


def battery_multiplier(matchers: str = "") -> str:
    """PromQL: how many times 12 V the battery of each controller has; `matchers` choose controllers."""
    told = f"morningstar_settings_voltage_multiplier_ratio{matchers}"
    highest = f"morningstar_battery_voltage_maximum_volts{matchers}"
    return (
        f"{told} or on ({_DEVICE}) "
        f"(1 + ({highest} >= bool {HIGHEST_VOLTS[12]}) + 2 * ({highest} >= bool {HIGHEST_VOLTS[24]}))"
    )


def rule_outputs() -> dict[str, str]:
    """The rule files by path from the repository."""
    maps = all_maps()
    files: dict[str, dict[str, Sequence[Recording | Alert]]] = {
        "recording.yml": {"prostar-gateway-recording": RECORDINGS},
        "alerts.yml": {
            "prostar-gateway": GATEWAY_ALERTS,
            "prostar-gateway-lines": LINE_ALERTS,
            "prostar-gateway-controllers": tuple(controller_alerts()),
            "prostar-gateway-faults-and-alarms": tuple(bit_alerts(maps)),
        },
    }
    mark = (
        "# Made by `prostar-gateway generate` from gateway/generate/rules.py and gateway/devices/maps. Do not edit.\n"
    )
    return {
        f"{FOLDER}/{name}": mark
        + dump(
            {"groups": [{"name": group, "rules": [rule.node() for rule in rules]} for group, rules in groups.items()]}
        )
        for name, groups in files.items()
    }


RECORDINGS: tuple[Recording, ...] = (
    Recording(_MULTIPLIER, battery_multiplier()),
    Recording(_PER_12V, f"morningstar_battery_voltage_slow_60s_volts / ({battery_multiplier()})"),
    Recording("site:morningstar_up:sum", "sum by (job, instance, site) (morningstar_up)"),
    Recording("site:morningstar_up:count", "count by (job, instance, site) (morningstar_up)"),
    Recording(
        "site:morningstar_charge_power_watts:sum", "sum by (job, instance, site) (morningstar_charge_power_watts)"
    ),
    Recording(
        "site:morningstar_load_power_watts:sum",
        "sum by (job, instance, site) (morningstar_load_voltage_volts * morningstar_load_current_amperes)",
    ),
    Recording(
        _ERRORS,
        f"""\
sum by ({_LINE}) (
    sum without (kind) (increase(prostar_gateway_device_errors_total{{kind!="exception"}}[6h]))
  and
    min_over_time(morningstar_up[6h]) == 1
)""",
    ),
    Recording(_ERROR_RATIO, f"{_ERRORS} / sum by ({_LINE}) (increase(prostar_gateway_line_requests_total[6h]) > 0)"),
)

GATEWAY_ALERTS: tuple[Alert, ...] = (
    Alert(
        "ProstarGatewayDown",
        f'up{{job="{JOB}"}} == 0',
        "2m",
        "critical",
        "The gateway {{ $labels.instance }} cannot be scraped",
        "No values and no alerts of its controllers come in. Is the process running, and reachable?",
    ),
    Alert(
        "ProstarGatewayNotReady",
        "prostar_gateway_ready == 0",
        "5m",
        "warning",
        "The gateway {{ $labels.instance }} does not listen on all that is configured",
        "/readyz names the addresses and the reasons.",
    ),
    Alert(
        "ProstarGatewayRestarts",
        "changes(prostar_gateway_start_time_seconds[1h]) > 2",
        "0s",
        "warning",
        "The gateway {{ $labels.instance }} was started {{ $value }} times within an hour",
        "Its log says why it ended.",
    ),
)

LINE_ALERTS: tuple[Alert, ...] = (
    Alert(
        "ProstarLineDown",
        "prostar_gateway_line_up == 0",
        "1m",
        "critical",
        f"The port of {_AT_LINE} is not open",
        "An adapter that is gone, a port that another program holds, or missing permission; the log names it.",
    ),
    Alert(
        "ProstarLineSaturated",
        f"prostar_gateway_line_use_ratio > {LINE_SATURATED_RATIO}",
        "15m",
        "warning",
        f"The {_AT_LINE} is busy for {{{{ $value | humanizePercentage }}}} of the time",
        "Values come less often than configured, and reads of clients wait. Poll less often (poll.live_s), ask for "
        "less, or put controllers on another line.",
    ),
    Alert(
        "ProstarLineErrors",
        f"{_ERROR_RATIO} > {FIELD_ERROR_RATIO:g} and {_ERRORS} >= {LEAST_ERRORS}",
        "15m",
        "warning",
        f"On {_AT_LINE} {{{{ $value | humanizePercentage }}}} of the requests failed",
        "Counted over six hours, without controllers that were away. Good lines stay below "
        f"{FIELD_ERROR_RATIO:g}: look at cabling, grounding, termination, and at what else is on the adapter's bus.",
    ),
    Alert(
        "ProstarHistoryStoreFailing",
        "prostar_gateway_history_store_up == 0",
        "5m",
        "warning",
        "The gateway {{ $labels.instance }} cannot store daily logs",
        "Live data goes on; days are kept in the controllers for 256 days. Is the disk full or read-only?",
    ),
    Alert(
        "ProstarHistoryLate",
        "prostar_gateway_history_last_harvest_age_seconds > 3 * 86400 and morningstar_up == 1",
        "1h",
        "warning",
        f"The daily log of {_AT} was last read {{{{ $value | humanizeDuration }}}} ago",
        "The controller answers, but its log does not get read to the end: see prostar_gateway_history_failures_total.",
    ),
    Alert(
        "ProstarHistoryWaits",
        "prostar_gateway_history_wait_seconds > 86400",
        "5m",
        "warning",
        f"The daily log of {_AT} has been waiting {{{{ $value | humanizeDuration }}}} for idle time on its line",
        "The log is never read ahead of a poll or a client, so on a line without idle time it is not read at all; the "
        "controller keeps 256 days. Poll less often (poll.live_s, or poll.night_s for the nights).",
    ),
    Alert(
        "ProstarStateDirUnusable",
        'prostar_gateway_condition{condition="state_dir_unusable"} == 1',
        "5m",
        "warning",
        "The gateway {{ $labels.instance }} cannot write to its state_dir",
        "Read-only or full. Live data goes on; daily logs are not stored, and writes to controllers are refused.",
    ),
    Alert(
        "ProstarReceiverSilent",
        "prostar_gateway_snmp_receiver_silent == 1",
        "10m",
        "warning",
        "The gateway {{ $labels.instance }} tells {{ $labels.receiver }} of conditions, and it does not acknowledge",
        "Informs go on to be sent, and the receiver gets what holds when it is back. The log says whether it refuses "
        "them.",
    ),
)


def controller_alerts() -> Iterator[Alert]:
    """What can be wrong with any controller."""
    yield Alert(
        "MorningstarOffline",
        'max without (state) (morningstar_device_state{state=~"offline|unknown"}) == 1',
        "5m",
        "critical",
        f"{_AT} does not answer",
        "Its values are shown nowhere until it does. Power, cabling, Modbus address, or the adapter of its line.",
    )
    yield Alert(
        "MorningstarStale",
        'max without (state) (morningstar_device_state{state="stale"}) == 1',
        "5m",
        "warning",
        f"{_AT} answers too seldom",
        "Several polls in a row were missed; its values are withheld meanwhile.",
    )
    yield Alert(
        "MorningstarIdentityMismatch",
        f'morningstar_condition{{condition="{IDENTITY_MISMATCH}"}} == 1',
        "0s",
        "critical",
        f"Another unit answers in the place of {_AT}",
        "Nothing of it is shown. Were adapters or controllers swapped? The log says what differs.",
    )
    yield Alert(
        "MorningstarSlaveControlNotRefreshed",
        f'morningstar_condition{{condition="{NOT_REWRITTEN}"}} == 1',
        "0s",
        "critical",
        f"Nobody rewrites the slave voltage of {_AT}",
        "It must be written at least once a minute, or the controller faults and stops charging.",
    )
    yield Alert(
        "MorningstarUnknownModel",
        f'morningstar_condition{{condition="{UNKNOWN_MODEL}"}} == 1',
        "1m",
        "warning",
        f"No map knows what {_AT} says that it is",
        "Modbus TCP serves it as it is, and nothing else shows its values. The log says what it calls itself.",
    )
    for name, (low, clear, severity, wait) in BATTERY_LIMITS.items():
        alert = f"MorningstarBattery{name}"
        yield Alert(
            alert,
            f"""\
  {_PER_12V} < {low}
or
    {_PER_12V} < {clear}
  and on ({_DEVICE})
    ALERTS{{alertname="{alert}", alertstate="firing"}} == 1""",
            wait,
            severity,
            f"The battery of {_AT} has {{{{ $value | printf `%.2f` }}}} V for each 12 V",
            f"Mean of a minute below {low} V ({2 * low:g} V in a 24 V system, {4 * low:g} V in one of 48 V); it ends "
            f"above {clear} V ({2 * clear:g} V, {4 * clear:g} V). The limits suit lead-acid batteries.",
        )
    yield Alert(
        "MorningstarNoChargeByDay",
        f"""\
    morningstar_array_voltage_volts
  > morningstar_battery_voltage_volts + {DAYLIGHT_VOLTS:g} * {_MULTIPLIER}
and
    morningstar_charge_current_amperes < 0.1
unless
    max without (state) (morningstar_charge_state{{state=~"absorption|float|equalize"}}) == 1""",
        "1h",
        "warning",
        f"{_AT} has light on its array and does not charge",
        "The array is well above the battery, no current flows, and the battery is not full.",
    )
    yield Alert(
        "MorningstarNoChargeInADay",
        """\
    increase(morningstar_charge_amperehours_total[26h]) < 0.5
and
    min_over_time(morningstar_up[26h]) == 1
and
    morningstar_charge_amperehours_total offset 25h""",
        "0s",
        "warning",
        f"{_AT} has charged nothing in a day and a night",
        "Snow on the array, an open array breaker, or a full battery that another source keeps up.",
    )
    yield Alert(
        "MorningstarImplausibleValues",
        "increase(prostar_gateway_device_implausible_total[1h]) > 0",
        "0s",
        "info",
        f"{_AT} gave values that cannot be",
        "They were withheld. See the registers, and whether another reading of the point fits (key decode).",
    )


def bit_alerts(maps: Sequence[DeviceMap]) -> Iterator[Alert]:
    """One for each name of a bit of the faults and alarms of now, and one for bits without a name."""
    named: dict[str, tuple[Point, Bit, list[str]]] = {}
    unnamed: dict[str, Point] = {}
    for device_map in maps:
        for point in filter(_alerts, device_map.points):
            unnamed.setdefault(_camel(f"morningstar_{_one_of(point)}_unnamed"), point)
            for bit in device_map.bit_tables[point.bits or ""]:
                name = _camel(f"morningstar_{_one_of(point)}_{bit.name}")
                _, _, places = named.setdefault(name, (point, bit, []))
                places.append(f"Bit {bit.number} of {point.symbol} of a {device_map.title}.")
    for name, (point, bit, places) in named.items():
        expr = f'{point.metric}{{bit="{bit.name}"}} == 1'
        yield Alert(name, expr, _WAIT[bit.severity], bit.severity, f"{_AT}: {bit.text}", " ".join(places))
    for name, point in unnamed.items():
        expr = f'{point.metric}{{bit=~"bit_[0-9]+"}} == 1'
        what = point.name.replace("_", " ")
        summary = f"{_AT}: {{{{ $labels.bit }}}} of the {what} is set, which no document names"
        yield Alert(name, expr, _WAIT["warning"], "warning", summary, point.help)


def _alerts(point: Point) -> bool:
    """Whether a point holds faults or alarms of this moment."""
    return point.bits is not None and point.group is Group.LIVE and point.metric is not None


def _one_of(point: Point) -> str:
    return point.name.removesuffix("s")


def _camel(name: str) -> str:
    return "".join(part[:1].upper() + part[1:] for part in name.split("_"))
