"""The parts of the demo: what it takes from a scrape, how it shows it, what it offers to try."""

from __future__ import annotations

import io
import tomllib
from pathlib import Path

import pytest
from rich.console import Console

from gateway.cli.demo import LAYOUT, Ports, demo_config
from gateway.cli.demo_commands import Try, commands_to_try
from gateway.cli.demo_screen import fitting, plain_lines
from gateway.cli.demo_view import DeviceView, LineView, Rates, View, read_view
from gateway.service.config import parse_config
from gateway.simulator.layout import DEMO_LAYOUT

REPOSITORY = Path(__file__).parents[2]
LABELS = 'device="{0}",line="{1}",model="prostar-mppt",site="s",unit_id="{2}"'


def scrape() -> str:
    text = ""
    for name, line, unit, quality in (("b", "two", 12, "offline"), ("a", "one", 11, "online")):
        labels = LABELS.format(name, line, unit)
        for state in ("unknown", "online", "stale", "offline"):
            text += f'morningstar_device_state{{{labels},state="{state}"}} {int(state == quality)}\n'
        if quality == "online":
            text += f"morningstar_battery_voltage_volts{{{labels}}} 13.25\n"
            text += f"morningstar_last_reply_age_seconds{{{labels}}} 0.5\n"
            text += f'morningstar_charge_state{{{labels},state="mppt"}} 1\n'
            text += f'morningstar_charge_state{{{labels},state="float"}} 0\n'
    for line, up in (("one", 1), ("two", 0)):
        labels = f'line="{line}",site="s"'
        text += f"prostar_gateway_line_up{{{labels}}} {up}\n"
        text += f"prostar_gateway_line_use_ratio{{{labels}}} 0.25\n"
        text += f"prostar_gateway_line_requests_total{{{labels}}} 40\n"
        for kind in ("timeout", "crc", "exception"):
            text += f'prostar_gateway_line_errors_total{{kind="{kind}",{labels}}} 2\n'
    return text


def test_a_view_is_what_the_scrape_says_and_no_more() -> None:
    view = read_view(scrape())
    assert view.devices == (
        DeviceView(11, "a", "one", {"battery_voltage": 13.25}, {"charge_state": "mppt"}, 0.5, "online"),
        DeviceView(12, "b", "two", {}, {}, None, "offline"),
    )
    assert view.lines == (
        LineView("one", up=True, use_ratio=0.25, requests=40, errors=4),
        LineView("two", up=False, use_ratio=0.25, requests=40, errors=4),
    )


def lines_view(requests: float) -> View:
    return View((), (LineView("one", up=True, use_ratio=0, requests=requests, errors=0),))


def test_rates_are_over_the_last_ten_seconds() -> None:
    rates = Rates()
    assert rates.add(lines_view(0), 100.0) == {}
    assert rates.add(lines_view(5), 101.0) == {"one": 5.0}
    shown = {}
    for second in range(2, 31):
        shown = dict(rates.add(lines_view(5 + 2 * (second - 1)), 100.0 + second))
    assert shown == {"one": 2.0}  # the five of the first second are forgotten


def picture(columns: int, rows: int) -> list[str]:
    stream = io.StringIO()
    console = Console(file=stream, width=columns, height=rows, force_terminal=False)
    commands = (Try("what it shows", "curl -s http://127.0.0.1:9850/metrics | grep battery_voltage_volts | cat -n"),)
    console.print(fitting(read_view(scrape()), {"one": 2.04}, commands, console))
    return stream.getvalue().splitlines()


def test_values_that_are_not_there_are_dashes() -> None:
    rows = picture(80, 40)
    online = next(row for row in rows if row.strip().startswith("11 "))
    assert online.split() == ["11", "a", "13.25", "V", "–", "–", "mppt", "0.5", "s", "online"]
    offline = next(row for row in rows if row.strip().startswith("12 "))
    assert offline.split() == ["12", "b", "–", "–", "–", "–", "–", "offline"]
    assert next(row for row in rows if row.split()[:2] == ["one", "up"]).split() == ["one", "up", "25%", "2.0", "4"]
    assert next(row for row in rows if row.split()[:2] == ["two", "down"]).split() == ["two", "down", "25%", "–", "4"]


@pytest.mark.parametrize("columns", [80, 120])
def test_the_picture_is_no_wider_than_the_terminal(columns: int) -> None:
    assert max(len(row) for row in picture(columns, 40)) <= columns


def test_a_low_terminal_drops_the_labels_and_then_moves_the_commands_up() -> None:
    assert any(row.startswith("# what it shows") for row in picture(80, 40))
    rows = picture(80, len(picture(80, 40)))
    assert not any(row.startswith("#") for row in rows)
    assert rows[-1].startswith("curl")
    low = picture(80, 10)
    assert low[1].startswith("curl")


def test_plain_lines_have_the_same() -> None:
    rows = plain_lines(read_view(scrape()), {"one": 2.04})
    assert (
        rows[0] == "one/a unit=11 battery=13.25V/– array=–/– load=–/– charge=mppt load_state=– age=0.5s quality=online"
    )
    assert rows[3] == "two DOWN use=25% requests/s=– errors=4"


def test_commands_are_short_enough_to_be_pasted_from_80_columns() -> None:
    commands = commands_to_try(1502, 1161, 9850, REPOSITORY)
    assert max(len(each.command) for each in commands) <= 80
    assert "pgwLiveTable" in "".join(each.command for each in commands)


def test_without_the_mib_the_commands_are_numeric(tmp_path: Path) -> None:
    text = "".join(each.command for each in commands_to_try(1502, 1161, 9850, tmp_path))
    assert "snmpwalk -v2c -c public 127.0.0.1:1161 1.3.6.1.4.1.32473.1" in text
    assert "mibs" not in text


def test_the_demo_has_the_simulators_layout_with_its_tristar_on_a_network_and_a_right_config(tmp_path: Path) -> None:
    simulated = [
        (plan.name, address, plan.models.get(address, "prostar-mppt"))
        for plan in DEMO_LAYOUT
        for address in plan.addresses
    ]
    shown = [(line, address, model) for line, devices in LAYOUT.items() for _, address, _, model in devices]
    tristar = ("shelter-b", 2, "tristar-mppt")
    assert shown == [*(each for each in simulated if each != tristar), ("hilltop", 1, "tristar-mppt")]
    assert tristar in simulated
    text = demo_config(tmp_path, Ports(modbus=1502, snmp=1161, http=9850, tristar=15020))
    config = parse_config(text)
    assert config.modbus.listen == ("127.0.0.1:1502",)
    assert config.snmp.listen == ("127.0.0.1:1161",)
    assert config.snmp.community[0].source == ("127.0.0.0/8",)
    assert config.http.listen == ("127.0.0.1:9850",)
    ports = [line["port"] for line in tomllib.loads(text)["line"]]
    assert ports == [str(tmp_path / "shelter-a"), str(tmp_path / "shelter-b"), "tcp://127.0.0.1:15020"]
