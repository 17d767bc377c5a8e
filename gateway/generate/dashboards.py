"""Grafana's dashboards: a site at one glance, one controller with all its points, one line with where its time goes.

What is to be seen first is chosen here. Every other point of a map has its place by what it measures: a new point
appears in the controller's dashboard without a word here, and a panel cannot ask for a metric that nobody makes.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

from gateway.devices.agreement import all_maps
from gateway.devices.model import DeviceMap, Group, Kind, Point
from gateway.devices.units import UNITS
from gateway.generate.panels import Panel, Query, Row, Variable, dashboard
from gateway.generate.rules import battery_multiplier

FOLDER = "deploy/grafana/dashboards"

SITE = Variable("site", "Site", "morningstar_up")
LINE = Variable("line", "Line", 'morningstar_up{site="$site"}')
LINES = Variable("line", "Line", 'morningstar_up{site="$site"}', several=True)
DEVICE = Variable("device", "Controller", 'morningstar_up{site="$site",line=~"$line"}')

_AT_SITE = '{site="$site"}'
_AT_LINE = '{site="$site",line="$line"}'
_OF_DEVICE = '{site="$site",line=~"$line",device="$device"}'

_GRAFANA_UNITS = {
    "volts": "volt",
    "amperes": "amp",
    "watts": "watt",
    "celsius": "celsius",
    "seconds": "s",
    "ohms": "ohm",
    "watthours": "watth",
    "amperehours": "amph",
    "ratio": "percentunit",
    "volts_per_celsius": "short",
    "": "short",
}
_MEASURED = {"volts": "Voltages", "amperes": "Currents", "watts": "Power", "celsius": "Temperatures"}
_UP_OR_DOWN = {"0": "away", "1": "online"}
_BAD_IF_ANY: Sequence[tuple[float | None, str]] = ((None, "green"), (1, "red"))
_GOOD_IF_ANY: Sequence[tuple[float | None, str]] = ((None, "red"), (1, "green"))


def dashboard_outputs() -> dict[str, str]:
    """The dashboards by path from the repository."""
    maps = all_maps()
    return {
        f"{FOLDER}/site.json": dashboard("prostar-site", "ProStar: site", [SITE], _site()),
        f"{FOLDER}/controller.json": dashboard(
            "prostar-controller", "ProStar: controller", [SITE, LINES, DEVICE], list(_controller(maps))
        ),
        f"{FOLDER}/line.json": dashboard("prostar-line", "ProStar: line", [SITE, LINE], _line()),
    }


def _stat(title: str, expr: str, unit: str = "short", **looks: object) -> Panel:
    return Panel(title, [Query(expr)], kind="stat", unit=unit, width=4, height=4, **looks)  # type: ignore[arg-type]  # Panel's own keys


def _site() -> list[Row]:
    by_device = "{{device}}"
    numbers = [
        _stat("Controllers online", f"sum(morningstar_up{_AT_SITE})"),
        _stat(
            "Controllers away", f"count(morningstar_up{_AT_SITE}) - sum(morningstar_up{_AT_SITE})", steps=_BAD_IF_ANY
        ),
        _stat("Charging", f"sum(morningstar_charge_power_watts{_AT_SITE})", "watt"),
        _stat(
            "Load",
            f"sum(morningstar_load_voltage_volts{_AT_SITE} * morningstar_load_current_amperes{_AT_SITE})",
            "watt",
        ),
        _stat(
            "Lowest battery, as 12 V",
            f"min(morningstar_battery_voltage_slow_60s_volts{_AT_SITE} / ({battery_multiplier(_AT_SITE)}))",
            "volt",
            steps=((None, "red"), (11.6, "orange"), (11.9, "yellow"), (12.1, "green")),
        ),
        _stat("Alerts firing", 'count(ALERTS{alertstate="firing",site="$site"}) or vector(0)', steps=_BAD_IF_ANY),
    ]
    graphs = [
        Panel("Battery voltage", [Query(f"morningstar_battery_voltage_volts{_AT_SITE}", by_device)], unit="volt"),
        Panel(
            "Charge power", [Query(f"morningstar_charge_power_watts{_AT_SITE}", by_device)], unit="watt", stacked=True
        ),
        Panel(
            "Current into the battery",
            [Query(f"morningstar_battery_current_net_amperes{_AT_SITE}", by_device)],
            unit="amp",
        ),
        Panel("Charge current", [Query(f"morningstar_charge_current_amperes{_AT_SITE}", by_device)], unit="amp"),
        Panel(
            "Load power",
            [
                Query(
                    f"morningstar_load_voltage_volts{_AT_SITE} * morningstar_load_current_amperes{_AT_SITE}", by_device
                )
            ],
            unit="watt",
            stacked=True,
        ),
        Panel("Charged today", [Query(f"morningstar_charge_today_amperehours{_AT_SITE}", by_device)], unit="amph"),
        Panel("Heatsink", [Query(f"morningstar_heatsink_temperature_celsius{_AT_SITE}", by_device)], unit="celsius"),
    ]
    states = [
        Panel(
            "Charge states",
            [Query(f"morningstar_charge_state{_AT_SITE} == 1", "{{device}}: {{state}}")],
            kind="state-timeline",
            description="A bar while the state holds.",
        ),
        Panel(
            "Faults and alarms",
            [
                Query(f"sum by (device) (morningstar_array_faults{_AT_SITE})", "{{device}}: faults of the array"),
                Query(f"sum by (device) (morningstar_load_faults{_AT_SITE})", "{{device}}: faults of the load"),
                Query(f"sum by (device) (morningstar_alarms{_AT_SITE})", "{{device}}: alarms"),
            ],
            kind="state-timeline",
            description="How many are there; the controller's dashboard names them.",
            steps=_BAD_IF_ANY,
        ),
    ]
    gateway = [
        Panel(
            "Reached",
            [Query(f"morningstar_up{_AT_SITE}", by_device)],
            kind="state-timeline",
            texts=_UP_OR_DOWN,
            steps=_GOOD_IF_ANY,
        ),
        Panel(
            "Use of the lines",
            [Query(f"prostar_gateway_line_use_ratio{_AT_SITE}", "{{line}}")],
            unit="percentunit",
            minimum=0,
            maximum=1,
        ),
        Panel(
            "Live values come every", [Query(f"prostar_gateway_device_refresh_seconds{_AT_SITE}", by_device)], unit="s"
        ),
        Panel(
            "Controllers",
            [
                Query(f"morningstar_device_info{_AT_SITE}", instant=True),
            ],
            kind="table",
            description="What each said of itself.",
        ),
    ]
    return [Row("Now", numbers), Row("Energy", graphs), Row("States", states), Row("Gateway", gateway)]


def _controller(maps: Sequence[DeviceMap]) -> Iterator[Row]:
    def of(metric: str) -> str:
        return f"{metric}{_OF_DEVICE}"

    yield Row(
        "Now",
        [
            _stat("Reached", of("morningstar_up"), texts=_UP_OR_DOWN, steps=_GOOD_IF_ANY),
            _stat("Last reply", of("morningstar_last_reply_age_seconds"), "s"),
            _stat("Battery", of("morningstar_battery_voltage_volts"), "volt"),
            _stat("Charging", of("morningstar_charge_power_watts"), "watt"),
            _stat("Array", of("morningstar_array_voltage_volts"), "volt"),
            _stat("Heatsink", of("morningstar_heatsink_temperature_celsius"), "celsius"),
        ],
    )
    live = [point for point in _points(maps) if point.group is Group.LIVE]
    states = [
        Panel(
            point.help.removesuffix("."), [Query(f"{of(point.metric or '')} == 1", "{{state}}")], kind="state-timeline"
        )
        for point in live
        if point.enumeration is not None
    ]
    bits = [
        Panel(
            point.help.removesuffix("."),
            [Query(of(point.metric or ""), "{{bit}}")],
            kind="state-timeline",
            height=12,
            texts={"0": "", "1": "set"},
            steps=_BAD_IF_ANY,
        )
        for point in live
        if point.bits is not None
    ]
    yield Row("Battery, array and load", list(_by_unit(live)))
    yield Row("States", states)
    yield Row("Faults and alarms", bits)
    totals = [point for point in _points(maps) if point.group is Group.ENERGY]
    today = [point for point in _points(maps) if point.group is Group.TODAY and point.bits is None]
    yield Row("Energy and time", [_table("Counters", totals), _table("Today", today)])
    settings = [point for point in _points(maps) if point.group is Group.SETTINGS and point.kind is Kind.NUMBER]
    texts = [point for point in _points(maps) if point.kind is Kind.TEXT]
    yield Row(
        "Settings",
        [
            _table(suffix.replace("_", " ") or "numbers", [point for point in settings if _suffix(point) == suffix])
            for suffix in dict.fromkeys(map(_suffix, settings))
        ]
        + ([_text_table("Texts", texts)] if texts else []),
    )
    yield Row(
        "Gateway",
        [
            Panel(
                "Failed requests",
                [
                    Query(
                        f"sum by (kind) (increase({of('prostar_gateway_device_errors_total')}[$__rate_interval]))",
                        "{{kind}}",
                    )
                ],
            ),
            Panel("Live values come every", [Query(of("prostar_gateway_device_refresh_seconds"), "period")], unit="s"),
            Panel(
                "Conditions that the gateway sees",
                [Query(of("morningstar_condition"), "{{condition}}")],
                kind="state-timeline",
                steps=_BAD_IF_ANY,
            ),
            Panel(
                "Share of the line's time",
                [Query(f"rate({of('prostar_gateway_device_line_seconds_total')}[$__rate_interval])", "share")],
                unit="percentunit",
            ),
        ],
    )


def _suffix(point: Point) -> str:
    return UNITS[point.unit].metric_suffix


def _points(maps: Sequence[DeviceMap]) -> Iterator[Point]:
    """The points of all models that are scraped, each metric once."""
    seen: set[str] = set()
    for device_map in maps:
        for point in device_map.points:
            if point.metric is not None and point.metric not in seen:
                seen.add(point.metric)
                yield point


def _by_unit(points: Iterable[Point]) -> Iterator[Panel]:
    """A graph for each measured quantity, with every point that measures it."""
    known = list(points)
    for suffix, title in _MEASURED.items():
        chosen = [point for point in known if _suffix(point) == suffix]
        if chosen:
            yield Panel(
                title,
                [Query(_named(chosen), "{{point}}")],
                description="A sensor that is not fitted has no line.",
                unit=_GRAFANA_UNITS[suffix],
                height=12,
            )


def _named(points: Sequence[Point]) -> str:
    """The points of the chosen controller, each with its name as the label `point`."""
    names = "|".join(point.metric or "" for point in points)
    matchers = _OF_DEVICE.removeprefix("{")
    return f'label_replace({{__name__=~"{names}",{matchers}, "point", "$1", "__name__", "morningstar_(.*)")'


def _table(title: str, points: Sequence[Point]) -> Panel:
    """One line a point, with its value of now."""
    units = set(map(_suffix, points))
    unit = _GRAFANA_UNITS[units.pop()] if len(units) == 1 else "short"
    return Panel(
        title.capitalize(),
        [Query(f"sum by (point) ({_named(points)})", instant=True)],
        kind="table",
        unit=unit,
        height=10,
    )


def _text_table(title: str, points: Sequence[Point]) -> Panel:
    """One line a text; the point's name and its text are in the columns `point` and the one called after it."""
    return Panel(title, [Query(_named(points), instant=True)], kind="table", height=10)


def _line() -> list[Row]:
    def of(metric: str) -> str:
        return f"{metric}{_AT_LINE}"

    def rate(metric: str) -> str:
        return f"rate({of(metric)}[$__rate_interval])"

    def quantiles(metric: str) -> list[Query]:
        buckets = f"sum by (le) (increase({of(metric + '_bucket')}[$__range]))"
        return [
            Query(f"histogram_quantile({share}, {buckets})", f"{share:.0%}", instant=True)
            for share in (0.5, 0.95, 0.99)
        ]

    now = [
        _stat("Port", of("prostar_gateway_line_up"), texts={"0": "closed", "1": "open"}, steps=_GOOD_IF_ANY),
        _stat(
            "Use",
            of("prostar_gateway_line_use_ratio"),
            "percentunit",
            steps=((None, "green"), (0.8, "yellow"), (0.95, "red")),
        ),
        _stat("Longer than asked for", of("prostar_gateway_line_stretch_ratio"), description="1: the line keeps up."),
        _stat("Clients waiting", of("prostar_gateway_line_queue_depth")),
        _stat(
            "Failed in an hour",
            f"sum(increase({of('prostar_gateway_line_errors_total')}[1h]))",
        ),
        _stat("Controllers online", f"sum({of('morningstar_up')})"),
    ]
    time = [
        Panel(
            "Where the time goes",
            [Query(rate("prostar_gateway_line_purpose_seconds_total"), "{{purpose}}")],
            unit="percentunit",
            stacked=True,
            minimum=0,
            maximum=1,
        ),
        Panel(
            "Where the time goes, by controller",
            [Query(rate("prostar_gateway_device_line_seconds_total"), "{{device}}")],
            unit="percentunit",
            stacked=True,
            minimum=0,
            maximum=1,
        ),
        Panel(
            "Where the time of clients goes",
            [Query(rate("prostar_gateway_line_client_seconds_total"), "{{client}}")],
            unit="percentunit",
            stacked=True,
            minimum=0,
        ),
        Panel("Live values come every", [Query(of("prostar_gateway_device_refresh_seconds"), "{{device}}")], unit="s"),
    ]
    requests = [
        Panel(
            "Requests",
            [
                Query(rate("prostar_gateway_line_polls_total"), "polls"),
                Query(rate("prostar_gateway_line_client_reads_total"), "reads of clients"),
                Query(rate("prostar_gateway_line_joined_reads_total"), "reads that shared one"),
                Query(rate("prostar_gateway_line_writes_total"), "writes"),
                Query(rate("prostar_gateway_line_retries_total"), "repetitions"),
            ],
            unit="reqps",
        ),
        Panel("Failed requests", [Query(rate("prostar_gateway_line_errors_total"), "{{kind}}")], unit="reqps"),
        Panel("Time until a reply is whole", quantiles("prostar_gateway_line_reply_seconds"), kind="stat", unit="s"),
        Panel("Time that clients wait", quantiles("prostar_gateway_line_queue_wait_seconds"), kind="stat", unit="s"),
        Panel(
            "Received and of no use",
            [
                Query(rate("prostar_gateway_line_discarded_bytes_total"), "bytes: {{kind}}"),
                Query(rate("prostar_gateway_line_discarded_frames_total"), "frames: {{kind}}"),
            ],
        ),
        Panel("Port opened", [Query(of("prostar_gateway_line_opens_total"), "times")]),
    ]
    return [Row("Now", now), Row("Time", time), Row("Requests", requests)]
