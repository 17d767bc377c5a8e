"""Every alert fires when it should and does not when it should not: in the real promtool, on made-up series."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from gateway.devices.model import Group
from gateway.devices.schema import load_map, models
from gateway.generate.rules import BATTERY_LIMITS, GATEWAY_ALERTS, LINE_ALERTS, bit_alerts, controller_alerts
from gateway.generate.rules import _camel as camel
from tests.deploy.promtool import DEVICE, LINE, RULES, TARGET, Scenario, run, series

UP = series("morningstar_up", "1x300")
PEER = {**DEVICE, "device": "array-2", "unit_id": "12"}


def state(name: str, values: str) -> dict[str, str]:
    return series("morningstar_device_state", values, state=name)


def battery(volts: str, multiplier: int) -> list[dict[str, str]]:
    return [
        series("morningstar_battery_voltage_slow_60s_volts", volts),
        series("morningstar_settings_voltage_multiplier_ratio", f"{multiplier}x200"),
    ]


def tristar_battery(volts: str, highest: str) -> list[dict[str, str]]:
    return [
        series("morningstar_battery_voltage_slow_60s_volts", volts),
        series("morningstar_battery_voltage_maximum_volts", f"{highest}x200"),
    ]


def by_day(array: str, current: str, **states: str) -> list[dict[str, str]]:
    return [
        series("morningstar_array_voltage_volts", array),
        series("morningstar_battery_voltage_volts", "25x200"),
        series("morningstar_settings_voltage_multiplier_ratio", "2x200"),
        series("morningstar_charge_current_amperes", current),
        *(series("morningstar_charge_state", values, state=name) for name, values in states.items()),
    ]


def errors(timeouts: str, crc: str, requests: str, up: str = "1x60") -> list[dict[str, str]]:
    return [
        series("prostar_gateway_device_errors_total", timeouts, kind="timeout"),
        series("prostar_gateway_device_errors_total", crc, kind="crc"),
        series("prostar_gateway_device_errors_total", "0+100x60", kind="exception"),
        series("prostar_gateway_line_requests_total", requests, LINE),
        series("morningstar_up", up),
    ]


SCENARIOS = (
    Scenario("ProstarGatewayDown", [series("up", "1x5 0x10", TARGET)], {5: 0, 7: 0, 9: 1}, "critical"),
    Scenario("ProstarGatewayDown", [series("up", "0x20", {**TARGET, "job": "another"})], {15: 0}),
    Scenario("ProstarGatewayNotReady", [series("prostar_gateway_ready", "1x5 0x10", TARGET)], {5: 0, 12: 1}, "warning"),
    Scenario(
        "ProstarGatewayRestarts",
        [series("prostar_gateway_start_time_seconds", "100x10 200x10 300x10 400x100", TARGET)],
        {25: 0, 35: 1, 125: 0},
        "warning",
    ),
    Scenario(
        "ProstarLineDown", [series("prostar_gateway_line_up", "1x5 0x10 1x5", LINE)], {6: 0, 8: 1, 18: 0}, "critical"
    ),
    Scenario(
        "ProstarLineSaturated",
        [series("prostar_gateway_line_use_ratio", "0.94x20 0.97x30", LINE)],
        {20: 0, 40: 1},
        "warning",
    ),
    Scenario(
        "ProstarLineSaturated", [series("prostar_gateway_line_use_ratio", "0.97x10 0.5x30", LINE)], {12: 0, 40: 0}
    ),
    # 60 requests a minute: 21,600 in six hours, of which 3 may fail by the field's measure
    Scenario("ProstarLineErrors", errors("0x60", "0+10x60", "0+600x60"), {10: 0, 200: 1, 500: 1}, "warning", step=10),
    Scenario("ProstarLineErrors", errors("0x60", "0x60", "0+600x60"), {500: 0}, step=10),
    # three failures
    Scenario("ProstarLineErrors", errors("0x9 1+0x50", "0x19 2+0x40", "0+600x60"), {500: 0}, step=10),
    # the controller was away for a while
    Scenario("ProstarLineErrors", errors("0+10x60", "0x60", "0+600x60", up="1x10 0x1 1x50"), {400: 0}, step=10),
    # 20 failures of 3 million requests
    Scenario("ProstarLineErrors", errors("0+0x30 0+10x2 20x28", "0x60", "0+90000x60"), {500: 0}, step=10),
    Scenario(
        "ProstarHistoryStoreFailing", [series("prostar_gateway_history_store_up", "1x5 0x20", TARGET)], {5: 0, 12: 1}
    ),
    Scenario(
        "ProstarStateDirUnusable",
        [series("prostar_gateway_condition", "0x5 1x20", TARGET, condition="state_dir_unusable")],
        {5: 0, 12: 1},
        "warning",
    ),
    Scenario(
        "ProstarReceiverSilent",
        [series("prostar_gateway_snmp_receiver_silent", "0x5 1x20 0x5", TARGET, receiver="192.0.2.7:162")],
        {5: 0, 20: 1, 28: 0},
        "warning",
    ),
    Scenario(
        "ProstarHistoryLate",
        [series("prostar_gateway_history_last_harvest_age_seconds", "259000+60x100"), UP],
        {1: 0, 60: 0, 80: 1},
        "warning",
    ),
    Scenario(
        "ProstarHistoryLate",
        [
            series("prostar_gateway_history_last_harvest_age_seconds", "400000+60x100"),
            series("morningstar_up", "0x100"),
        ],
        {90: 0},
    ),
    Scenario(
        "ProstarHistoryWaits",
        [series("prostar_gateway_history_wait_seconds", "86000+60x30 0x30")],
        {6: 0, 20: 1, 40: 0},
        "warning",
    ),
    Scenario(
        "MorningstarOffline",
        [
            state("offline", "0x5 1x20 0x20"),
            state("online", "1x5 0x20 1x20"),
            state("unknown", "0x45"),
            state("stale", "0x45"),
        ],
        {5: 0, 8: 0, 12: 1, 30: 0},
        "critical",
        labels={"device": "array-1", "line": "shelter-a"},
    ),
    Scenario(
        "MorningstarOffline", [state("unknown", "1x4 0x20"), state("offline", "0x4 1x20")], {4: 0, 7: 1}, "critical"
    ),
    Scenario("MorningstarOffline", [state("stale", "1x20"), state("offline", "0x20")], {15: 0}),
    Scenario("MorningstarStale", [state("stale", "0x5 1x20 0x5")], {5: 0, 12: 1, 27: 0}, "warning"),
    Scenario(
        "MorningstarIdentityMismatch",
        [
            series("morningstar_condition", "0x5 1x5 0x5", condition="identity_mismatch"),
            series("morningstar_condition", "0x15", PEER, condition="identity_mismatch"),
            series("morningstar_condition", "1x15", PEER, condition="of_another_kind"),
        ],
        {5: 0, 7: 1, 13: 0},
        "critical",
    ),
    Scenario(
        "MorningstarSlaveControlNotRefreshed",
        [series("morningstar_condition", "0x5 1x5 0x5", condition="slave_control_not_refreshed")],
        {5: 0, 7: 1, 13: 0},
        "critical",
    ),
    Scenario(
        "MorningstarUnknownModel",
        [
            series("morningstar_condition", "0x5 1x10 0x5", condition="unknown_model"),
            series("morningstar_condition", "0x20", PEER, condition="unknown_model"),
        ],
        {5: 0, 8: 1, 14: 1, 18: 0},
        "warning",
    ),
    # 48 V, of a controller that tells no multiplier but the highest voltage that it has seen
    Scenario("MorningstarBatteryLow", tristar_battery("48.5x20 47.2x40", "59.6"), {15: 0, 35: 1, 55: 1}, "warning"),
    Scenario("MorningstarBatteryLow", tristar_battery("24.5x20 23.6x40", "29.8"), {15: 0, 35: 1}, "warning"),
    Scenario("MorningstarBatteryLow", tristar_battery("12.3x20 11.8x40", "14.9"), {15: 0, 35: 1}, "warning"),
    Scenario("MorningstarBatteryVeryLow", tristar_battery("47x20 46x15 47x5", "59.6"), {15: 0, 30: 1}, "critical"),
    Scenario(
        "MorningstarNoChargeByDay",
        [
            *tristar_battery("50x200", "59.6"),
            series("morningstar_array_voltage_volts", "70x200"),
            series("morningstar_battery_voltage_volts", "50x200"),
            series("morningstar_charge_current_amperes", "0x200"),
            series("morningstar_charge_state", "1x200", state="mppt"),
        ],
        {30: 0, 70: 1},
        "warning",
    ),
    # 12 V: fires below 11.9, ends above 12.1, and one step of a half-precision float (7.8 mV) changes nothing
    Scenario("MorningstarBatteryLow", battery("12x20 11.95x40", 1), {15: 0, 55: 0}, "warning"),
    Scenario(
        "MorningstarBatteryLow",
        battery("11.8828125x15 11.890625x5 11.8984375x5 11.90625x10 12.09375x10 12.1015625x10", 1),
        {8: 0, 12: 1, 18: 1, 24: 1, 34: 1, 44: 1, 52: 0},
        "warning",
    ),
    # 24 V: the same limits doubled; a step is 15.6 mV
    Scenario("MorningstarBatteryLow", battery("24.2x20 23.90x40", 2), {15: 0, 55: 0}, "warning"),
    Scenario(
        "MorningstarBatteryLow",
        battery("23.78125x15 23.796875x10 23.8125x10 24.1875x10 24.203125x10", 2),
        {8: 0, 12: 1, 24: 1, 34: 1, 44: 1, 50: 0},
        "warning",
    ),
    Scenario("MorningstarBatteryLow", battery("11.8x5 12.0x30", 1), {30: 0}),  # not for ten minutes
    Scenario(
        "MorningstarBatteryVeryLow",
        battery("11.7x15 11.5x15 11.7x15 11.9x15", 1),
        {14: 0, 18: 0, 25: 1, 40: 1, 50: 0},
        "critical",
    ),
    Scenario(
        "MorningstarBatteryVeryLow",
        battery("23.4x15 23.0x15 23.4x15 23.8x15", 2),
        {14: 0, 18: 0, 25: 1, 40: 1, 50: 0},
        "critical",
    ),
    Scenario(
        "MorningstarNoChargeByDay", by_day("60x100", "0x100", mppt="1x100", float="0x100"), {30: 0, 70: 1}, "warning"
    ),
    Scenario("MorningstarNoChargeByDay", by_day("60x100", "8x100", mppt="1x100"), {90: 0}),
    Scenario("MorningstarNoChargeByDay", by_day("60x100", "0x100", mppt="0x100", float="1x100"), {90: 0}),
    Scenario("MorningstarNoChargeByDay", by_day("0.5x100", "0x100", night="1x100"), {90: 0}),
    Scenario("MorningstarNoChargeByDay", by_day("27x100", "0x100", mppt="1x100"), {90: 0}),  # dusk
    Scenario(
        "MorningstarNoChargeInADay",
        [series("morningstar_charge_amperehours_total", "0+10x10 100x200"), UP],
        {1000: 0, 1600: 0, 1800: 1},
        "warning",
        step=10,
    ),
    Scenario(
        "MorningstarNoChargeInADay",
        [series("morningstar_charge_amperehours_total", "100x160"), UP],
        {1000: 0, 1400: 0},  # known for less than a day
        step=10,
    ),
    Scenario(
        "MorningstarNoChargeInADay",
        [series("morningstar_charge_amperehours_total", "100x200"), series("morningstar_up", "1x50 0x1 1x150")],
        {1900: 0},
        step=10,
    ),
    Scenario(
        "MorningstarImplausibleValues",
        [series("prostar_gateway_device_implausible_total", "0x10 1x100")],
        {9: 0, 20: 1, 100: 0},
        "info",
    ),
)


def bit_scenarios() -> Iterator[Scenario]:
    """Each named fault and alarm alone, beside a controller that has all the others; by the map, not by the rules."""
    for model in models():
        device_map = load_map(model)
        for point in device_map.points:
            if point.bits is None or point.group is not Group.LIVE:
                continue
            assert point.metric is not None
            bits = device_map.bit_tables[point.bits]
            kind = point.name.removesuffix("s")
            for bit in bits:
                own = series(point.metric, "0x5 1x10 0x5", bit=bit.name)
                others = [series(point.metric, "1x20", PEER, bit=other.name) for other in bits if other is not bit]
                minutes = {"critical": {4: 0, 6: 1, 14: 1, 17: 0}, "warning": {4: 0, 6: 0, 8: 1, 17: 0}}
                yield Scenario(
                    camel(f"morningstar_{kind}_{bit.name}"),
                    [own, *others],
                    minutes.get(bit.severity, {4: 0, 8: 0, 12: 1, 17: 0}),
                    bit.severity,
                )
            yield Scenario(
                camel(f"morningstar_{kind}_unnamed"),
                [series(point.metric, "_x5 1x10", bit="bit_31"), series(point.metric, "1x20", bit=bits[0].name)],
                {4: 0, 9: 1},
                "warning",
                labels={"bit": "bit_31"},
            )


def test_every_alert_has_a_scenario_in_which_it_fires_and_one_in_which_it_does_not() -> None:
    fires: set[str] = set()
    silent: set[str] = set()
    for scenario in (*SCENARIOS, *bit_scenarios()):
        fires |= {scenario.alert} if any(scenario.fires.values()) else set()
        silent |= {scenario.alert} if 0 in scenario.fires.values() else set()
    maps = [load_map(model) for model in models()]
    alerts = {alert.name for alert in (*GATEWAY_ALERTS, *LINE_ALERTS, *controller_alerts(), *bit_alerts(maps))}
    assert fires == alerts
    assert silent == alerts


@pytest.mark.peer
def test_alerts_of_every_site(peer: Callable[[str], str], tmp_path: Path) -> None:
    assert run(peer("promtool"), tmp_path, SCENARIOS) == ""


@pytest.mark.peer
def test_each_fault_and_alarm_of_the_maps(peer: Callable[[str], str], tmp_path: Path) -> None:
    scenarios = list(bit_scenarios())
    assert len(scenarios) > 45
    assert run(peer("promtool"), tmp_path, scenarios) == ""


@pytest.mark.peer
def test_a_wrong_expectation_is_noticed(peer: Callable[[str], str], tmp_path: Path) -> None:
    wrong = Scenario("ProstarLineDown", [series("prostar_gateway_line_up", "1x20", LINE)], {10: 1})
    assert "ProstarLineDown" in run(peer("promtool"), tmp_path, [wrong])


@pytest.mark.peer
def test_promtool_finds_nothing_wrong_with_the_rules(peer: Callable[[str], str]) -> None:
    done = subprocess.run(
        [peer("promtool"), "check", "rules", "--lint-fatal", *map(str, RULES)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.count("SUCCESS") == len(RULES) == 2


@pytest.mark.parametrize("volts", [8.0, 15.99, 16.0, 31.98])
def test_both_battery_limits_are_further_apart_than_a_step_of_the_reading(volts: float) -> None:
    step_v = 2**-7 if volts < 16 else 2**-6
    multiplier = 1 if volts < 16 else 2
    for low, clear, _, _ in BATTERY_LIMITS.values():
        assert (clear - low) * multiplier > 2 * step_v


def test_texts_name_the_place() -> None:
    text = "\n".join(path.read_text(encoding="utf-8") for path in RULES)
    summaries = re.findall(r'summary: "(.*)"', text)
    assert len(summaries) > 60
    assert [each for each in summaries if "{{ $labels." not in each] == []
