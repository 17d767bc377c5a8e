"""All files that are derived from the maps: made, written, compared.

Derived files are committed, so that a reader needs no tool and a review shows what a change of a map does to the
MIB, the metrics and the pages. `check` is the guard: CI fails while a committed file is not what would be made.
"""

from __future__ import annotations

from pathlib import Path

from gateway.generate.dashboards import dashboard_outputs
from gateway.generate.librenms import librenms_outputs
from gateway.generate.metrics import metric_outputs
from gateway.generate.mib import mib_outputs
from gateway.generate.registers import register_outputs
from gateway.generate.rules import rule_outputs
from gateway.generate.snmp_exporter import exporter_outputs
from gateway.generate.telegraf import telegraf_outputs
from gateway.generate.zabbix import zabbix_outputs


def outputs() -> dict[str, str]:
    """Every derived file: path from the repository's root → text."""
    made: dict[str, str] = {}
    for part in (
        mib_outputs(),
        register_outputs(),
        metric_outputs(),
        rule_outputs(),
        dashboard_outputs(),
        exporter_outputs(),
        librenms_outputs(),
        telegraf_outputs(),
        zabbix_outputs(),
    ):
        for path, text in part.items():
            if path in made:
                raise ValueError(f"{path} is made twice")
            made[path] = text
    return dict(sorted(made.items()))


def write(root: Path) -> list[str]:
    """Write what differs under `root` and remove pages of models that are gone; returns the paths touched."""
    made = outputs()
    touched = check(root, made)
    for path in touched:
        target = root / path
        if path in made:
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_text(made[path], encoding="utf-8")
        else:
            target.unlink()
    return touched


def check(root: Path, made: dict[str, str] | None = None) -> list[str]:
    """Paths under `root` that are missing, differ from what would be made, or describe a model that is gone."""
    made = outputs() if made is None else made
    differing = [path for path, text in made.items() if _read(root / path) != text]
    left_over = {f"docs/registers/{page.name}" for page in (root / "docs" / "registers").glob("*.md")} - made.keys()
    return sorted([*differing, *left_over])


def _read(path: Path) -> str | None:
    try:
        return path.read_bytes().decode("utf-8")
    except (FileNotFoundError, UnicodeDecodeError):
        return None
