"""Every query of every dashboard gives data, in a real Prometheus that scraped a real gateway; and the files fit."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest

from gateway.devices.schema import load_map, models
from tests.deploy.conftest import Server
from tests.deploy.promtool import REPOSITORY

DASHBOARDS = sorted((REPOSITORY / "deploy" / "grafana" / "dashboards").glob("*.json"))
CHOSEN = {
    "$site": "ridge-07",
    "$line": "shelter-a",
    "$device": "array-1",
    "$__rate_interval": "10s",
    "$__range": "1m",
}

TRISTAR_CHOSEN = {**CHOSEN, "$line": "shelter-b", "$device": "array-4"}
PER_12V = "device:morningstar_battery_voltage_volts:per_12v"


def loaded(path: Path) -> dict[str, Any]:
    node: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return node


def panels(path: Path) -> list[dict[str, Any]]:
    return [panel for panel in loaded(path)["panels"] if panel["type"] != "row"]


def queries(chosen: Mapping[str, str] = CHOSEN) -> Iterator[tuple[str, str, str]]:
    """Dashboard, panel, expression with everything chosen."""
    for path in DASHBOARDS:
        for panel in panels(path):
            for target in panel["targets"]:
                expr = target["expr"]
                for variable, value in chosen.items():
                    expr = expr.replace(variable, value)
                yield path.stem, panel["title"], expr


def test_the_dashboards_are_there() -> None:
    assert [path.stem for path in DASHBOARDS] == ["controller", "line", "site"]
    assert len(list(queries())) > 70


@pytest.mark.peer
def test_every_query_gives_data(server: Server) -> None:
    """Of a ProStar, or else of a TriStar: each has what the other has not."""
    both = zip(queries(), queries(TRISTAR_CHOSEN), strict=True)
    empty = [one for one, other in both if not server.query(one[2]) and not server.query(other[2])]
    assert empty == []


@pytest.mark.peer
@pytest.mark.parametrize("chosen", [CHOSEN, TRISTAR_CHOSEN], ids=["prostar", "tristar"])
def test_what_comes_first_is_there_for_every_model(server: Server, chosen: Mapping[str, str]) -> None:
    first = {"Reached", "Last reply", "Battery", "Charging", "Array", "Heatsink", "Voltages", "Currents", "Power"}
    titles = {title for where, title, expr in queries(chosen) if where == "controller" and server.query(expr)}
    assert first <= titles


@pytest.mark.peer
def test_what_a_battery_has_for_each_12_v_is_known_of_every_controller(server: Server) -> None:
    found = {each["metric"]["device"]: float(each["value"][1]) for each in server.query(PER_12V)}
    assert found.keys() == {"array-1", "array-2", "array-3", "array-4"}
    assert all(10.5 < volts < 16 for volts in found.values())


@pytest.mark.peer
def test_every_variable_has_values(server: Server) -> None:
    for path in DASHBOARDS:
        for variable in loaded(path)["templating"]["list"]:
            if variable["type"] == "datasource":
                continue
            found = re.fullmatch(r"label_values\((?P<metric>.+), (?P<label>\w+)\)", variable["query"]["query"])
            assert found is not None
            metric = found["metric"].replace("$site", "ridge-07").replace("$line", ".*")
            series = server.ask("series", **{"match[]": metric})
            values = {str(each[found["label"]]) for each in series}
            expected = {
                "site": {"ridge-07"},
                "line": {"shelter-a", "shelter-b"},
                "device": {"array-1", "array-2", "array-3", "array-4"},
            }
            assert values == expected[variable["name"]]


@pytest.mark.peer
def test_the_delivered_configuration_finds_the_gateway_and_its_site(server: Server) -> None:
    [up] = server.query("up")
    metric = up["metric"]
    assert {name: metric[name] for name in ("job", "site")} == {"job": "prostar-gateway", "site": "ridge-07"}
    assert server.query('{__name__=~".+",exported_site!=""}') == []
    [build] = server.query("prostar_gateway_build_info")
    assert build["metric"]["site"] == "ridge-07"


@pytest.mark.peer
def test_the_rules_are_loaded_and_evaluated_without_an_error(server: Server) -> None:
    groups = server.ask("rules")
    rules = [rule for group in groups["groups"] for rule in group["rules"]]
    assert len(rules) > 70
    assert [(rule["name"], rule.get("lastError")) for rule in rules if rule["health"] not in ("ok", "unknown")] == []
    assert server.query("device:morningstar_battery_voltage_volts:per_12v")
    assert server.query("site:morningstar_charge_power_watts:sum")
    assert server.query("line:prostar_gateway_device_errors:ratio6h")


@pytest.mark.parametrize("path", DASHBOARDS, ids=lambda path: path.stem)
def test_a_dashboard_is_well_formed(path: Path) -> None:
    node = loaded(path)
    assert node["uid"] == f"prostar-{path.stem}"
    everything = node["panels"]
    numbers = [panel["id"] for panel in everything]
    assert len(numbers) == len(set(numbers))
    taken: set[tuple[int, int]] = set()
    for panel in everything:
        place = panel["gridPos"]
        assert place["x"] + place["w"] <= 24
        cells = {
            (x, y)
            for x in range(place["x"], place["x"] + place["w"])
            for y in range(place["y"], place["y"] + place["h"])
        }
        assert not cells & taken, f"{panel['title']} lies on another panel"
        taken |= cells
    for panel in panels(path):
        assert panel["type"] in {"timeseries", "stat", "state-timeline", "table"}
        assert panel["title"]
        assert panel["targets"]
        references = [target["refId"] for target in panel["targets"]]
        assert len(references) == len(set(references))
        assert all(re.fullmatch("[A-Z]", reference) for reference in references)
        assert {target["datasource"]["uid"] for target in panel["targets"]} == {"${datasource}"}
    variables = {variable["name"] for variable in node["templating"]["list"]}
    text = path.read_text(encoding="utf-8")
    used = set(re.findall(r"\$\{?([a-z]+)", text)) - {"__rate_interval", "__range", "__all", "__auto"}
    assert used - {""} <= variables


@pytest.mark.parametrize("model", models())
def test_every_live_point_of_a_map_is_in_the_controllers_dashboard(model: str) -> None:
    text = (REPOSITORY / "deploy" / "grafana" / "dashboards" / "controller.json").read_text(encoding="utf-8")
    shown = set(re.findall(r"morningstar_\w+", text))
    group = [point for point in load_map(model).points if point.metric is not None and point.group.value == "live"]
    assert [point.name for point in group if point.metric not in shown] == []
