"""Grafana's JSON, as much of it as the dashboards use: variables, panels and a layout in rows of 24 columns.

Rule 1: a dashboard holds no address and no identity of a data source: a variable chooses it.
Rule 2: every query ends in samples while a gateway is scraped; a panel that is empty on a healthy site is a mistake.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

COLUMNS = 24
TAG = "prostar-gateway"

Json = str | int | float | bool | None | Mapping[str, "Json"] | Sequence["Json"]

_SOURCE: Mapping[str, Json] = {"type": "prometheus", "uid": "${datasource}"}


@dataclass(frozen=True, slots=True)
class Query:
    """A PromQL expression and how its series are called."""

    expr: str
    legend: str = ""
    instant: bool = False


@dataclass(frozen=True, slots=True)
class Panel:
    """One picture: what it is called, what it asks, how it looks."""

    title: str
    queries: Sequence[Query]
    kind: str = "timeseries"  # timeseries, stat, state-timeline or table
    unit: str = "short"
    width: int = 12
    height: int = 8
    description: str = ""
    minimum: float | None = None
    maximum: float | None = None
    steps: Sequence[tuple[float | None, str]] = ()  # from which value on, in which colour
    texts: Mapping[str, str] = field(default_factory=dict)  # number → what is shown instead
    stacked: bool = False

    def node(self, number: int, left: int, top: int) -> Mapping[str, Json]:
        """As Grafana reads it."""
        defaults: dict[str, Json] = {"unit": self.unit, "mappings": self._mappings()}
        if self.minimum is not None:
            defaults["min"] = self.minimum
        if self.maximum is not None:
            defaults["max"] = self.maximum
        if self.steps:
            defaults["thresholds"] = {
                "mode": "absolute",
                "steps": [{"value": value, "color": colour} for value, colour in self.steps],
            }
        if self.kind == "timeseries":
            stacking = {"mode": "normal" if self.stacked else "none", "group": "A"}
            defaults["custom"] = {"fillOpacity": 20 if self.stacked else 0, "showPoints": "never", "stacking": stacking}
        return {
            "id": number,
            "type": self.kind,
            "title": self.title,
            "description": self.description,
            "datasource": _SOURCE,
            "gridPos": {"x": left, "y": top, "w": self.width, "h": self.height},
            "fieldConfig": {"defaults": defaults, "overrides": []},
            "options": self._options(),
            "transformations": [{"id": "merge", "options": {}}] if self.kind == "table" else [],
            "targets": [
                {
                    "refId": chr(ord("A") + index),
                    "datasource": _SOURCE,
                    "expr": query.expr,
                    "legendFormat": query.legend or "__auto",
                    "instant": query.instant,
                    "range": not query.instant,
                    "format": "table" if self.kind == "table" else "time_series",
                }
                for index, query in enumerate(self.queries)
            ],
        }

    def _mappings(self) -> Json:
        if not self.texts:
            return []
        return [{"type": "value", "options": {value: {"text": text} for value, text in self.texts.items()}}]

    def _options(self) -> Mapping[str, Json]:
        if self.kind == "stat":
            return {
                "colorMode": "value",
                "graphMode": "area",
                "reduceOptions": {"calcs": ["lastNotNull"], "fields": "", "values": False},
            }
        if self.kind == "state-timeline":
            return {"mergeValues": True, "showValue": "never", "rowHeight": 0.9, "legend": {"showLegend": False}}
        if self.kind == "table":
            return {"showHeader": True}
        return {
            "legend": {"displayMode": "table", "placement": "bottom", "calcs": ["lastNotNull", "min", "max"]},
            "tooltip": {"mode": "multi", "sort": "desc"},
        }


@dataclass(frozen=True, slots=True)
class Row:
    """A heading over the panels that follow it."""

    title: str
    panels: Sequence[Panel]


@dataclass(frozen=True, slots=True)
class Variable:
    """A choice above the panels; its values are those of a label."""

    name: str
    title: str
    metric: str
    several: bool = False

    def node(self) -> Mapping[str, Json]:
        """As Grafana reads it."""
        query = f"label_values({self.metric}, {self.name})"
        return {
            "name": self.name,
            "label": self.title,
            "type": "query",
            "datasource": _SOURCE,
            "definition": query,
            "query": {"query": query, "refId": self.name},
            "refresh": 2,
            "sort": 1,
            "multi": self.several,
            "includeAll": self.several,
            "current": {"text": ["All"], "value": ["$__all"]} if self.several else {},
        }


def dashboard(uid: str, title: str, variables: Sequence[Variable], rows: Sequence[Row]) -> str:
    """The file of a dashboard."""
    source: Mapping[str, Json] = {
        "name": "datasource",
        "label": "Data source",
        "type": "datasource",
        "query": "prometheus",
        "current": {},
    }
    link: Mapping[str, Json] = {
        "type": "dashboards",
        "title": "ProStar",
        "tags": [TAG],
        "asDropdown": False,
        "includeVars": True,
        "keepTime": True,
    }
    node: Mapping[str, Json] = {
        "uid": uid,
        "title": title,
        "tags": [TAG],
        "schemaVersion": 39,
        "editable": True,
        "refresh": "30s",
        "time": {"from": "now-6h", "to": "now"},
        "timezone": "browser",
        "links": [link],
        "templating": {"list": [source, *(variable.node() for variable in variables)]},
        "panels": _laid_out(rows),
    }
    return json.dumps(node, indent=2, ensure_ascii=False) + "\n"


def _laid_out(rows: Sequence[Row]) -> list[Json]:
    """Rows below each other; within one, panels from left to right as long as there is room."""
    nodes: list[Json] = []
    top = 0
    for row in rows:
        place: Json = {"x": 0, "y": top, "w": COLUMNS, "h": 1}
        nodes.append({"id": len(nodes) + 1, "type": "row", "title": row.title, "gridPos": place, "panels": []})
        top += 1
        left = height = 0
        for panel in row.panels:
            if left + panel.width > COLUMNS:
                top, left, height = top + height, 0, 0
            nodes.append(panel.node(len(nodes) + 1, left, top))
            left, height = left + panel.width, max(height, panel.height)
        top += height
    return nodes
