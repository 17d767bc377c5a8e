"""Promtool's rule tests, written from Python: JSON is YAML."""

from __future__ import annotations

import json
import re
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

REPOSITORY = Path(__file__).parents[2]
RULES = sorted((REPOSITORY / "deploy" / "prometheus" / "rules").glob("*.yml"))

GROUPS = sorted(
    (name for path in RULES for name in re.findall(r'- name: "(.*)"', path.read_text(encoding="utf-8"))),
    key=lambda name: not name.endswith("-recording"),
)
"""What is recorded comes first: promtool does not let it wait for the next evaluation."""

TARGET = {"job": "prostar-gateway", "instance": "gw:9850"}
LINE = {**TARGET, "site": "ridge-07", "line": "shelter-a"}
DEVICE = {**LINE, "device": "array-1", "unit_id": "11", "model": "prostar-mppt"}


def series(metric: str, values: str, labels: Mapping[str, str] = DEVICE, **more: str) -> dict[str, str]:
    """A series in promtool's notation (`1x10`, `0+1x10`, `_x5`), a sample a step."""
    pairs = ",".join(f"{name}={json.dumps(value)}" for name, value in sorted({**labels, **more}.items()))
    return {"series": f"{metric}{{{pairs}}}", "values": values}


@dataclass(frozen=True)
class Scenario:
    """What happens, and when the alert is there: minute → number of alerts that fire."""

    alert: str
    series: Sequence[dict[str, str]]
    fires: Mapping[int, int]
    severity: str = ""
    labels: Mapping[str, str] = field(default_factory=dict)  # some of its labels
    step: int = 1  # minutes between two samples, and between two evaluations


def promtool_test(scenarios: Sequence[Scenario], step: int) -> dict[str, object]:
    """The file that `promtool test rules` takes; counts alerts, so that it need not repeat their texts."""
    return {
        "rule_files": [str(path) for path in RULES],
        "evaluation_interval": f"{step}m",
        "group_eval_order": GROUPS,
        "tests": [
            {
                "name": f"{scenario.alert} {number}",
                "interval": f"{step}m",
                "input_series": list(scenario.series),
                "promql_expr_test": [
                    {
                        "expr": f"count(ALERTS{{{_wanted(scenario)}}}) or vector(0)",
                        "eval_time": f"{minute}m",
                        "exp_samples": [{"labels": "{}", "value": count}],
                    }
                    for minute, count in scenario.fires.items()
                ],
            }
            for number, scenario in enumerate(scenarios)
        ],
    }


def _wanted(scenario: Scenario) -> str:
    wanted = {"alertname": scenario.alert, "alertstate": "firing", **scenario.labels}
    if scenario.severity:
        wanted["severity"] = scenario.severity
    return ",".join(f"{name}={json.dumps(value)}" for name, value in wanted.items())


def run(promtool: str, folder: Path, scenarios: Sequence[Scenario]) -> str:
    """What promtool complains about; "" when all scenarios hold."""
    said = ""
    for step in {scenario.step for scenario in scenarios}:
        path = folder / f"tests-{step}.json"
        chosen = [scenario for scenario in scenarios if scenario.step == step]
        path.write_text(json.dumps(promtool_test(chosen, step)), encoding="utf-8")
        done = subprocess.run(
            [promtool, "test", "rules", str(path)], capture_output=True, text=True, timeout=100, check=False
        )
        said += "" if done.returncode == 0 else done.stdout + done.stderr
    return said
