"""Every query of every dashboard gives data, in a real Prometheus that scraped a real gateway; and the files fit."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
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


def loaded(path: Path) -> dict[str, Any]:
    node: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return node


def panels(path: Path) -> list[dict[str, Any]]:
    return [panel for panel in loaded(path)["panels"] if panel["type"] != "row"]


def queries() -> Iterator[tuple[str, str, str]]:
    """Dashboard, panel, expression with everything chosen."""
    for path in DASHBOARDS:
        for panel in panels(path):
            for target in panel["targets"]:
                expr = target["expr"]
                for variable, value in CHOSEN.items():
                    expr = expr.replace(variable, value)
                yield path.stem, panel["title"], expr


def test_the_dashboards_are_there() -> None:
    assert [path.stem for path in DASHBOARDS] == ["controller", "line", "site"]
    assert len(list(queries())) > 70


@pytest.mark.peer
def test_every_query_gives_data(server: Server) -> None:
    empty = [(where, title, expr) for where, title, expr in queries() if not server.query(expr)]
    assert empty == []


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
                "device": {"array-1", "array-2", "array-3"},
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
