"""All files that are derived from the maps: made, written, compared.

Derived files are committed, so that a reader needs no tool and a review shows what a change of a map does to the
MIB, the metrics and the pages. `check` is the guard: CI fails while a committed file is not what would be made.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from gateway.faces.snmp.settings import DEFAULT_ROOT, Oid
from gateway.generate.dashboards import dashboard_outputs
from gateway.generate.librenms import librenms_outputs
from gateway.generate.maps import map_outputs
from gateway.generate.metrics import metric_outputs
from gateway.generate.mib import LOCK, mib_outputs
from gateway.generate.registers import register_outputs
from gateway.generate.rules import rule_outputs
from gateway.generate.snmp_exporter import exporter_outputs
from gateway.generate.snmpd import snmpd_outputs
from gateway.generate.status import status_outputs
from gateway.generate.telegraf import telegraf_outputs
from gateway.generate.zabbix import zabbix_outputs

_PAGES = "docs/registers/"


def outputs() -> dict[str, str]:
    """Every derived file: path from the repository's root → text."""
    return _together(
        map_outputs(),
        mib_outputs(),
        register_outputs(),
        status_outputs(),
        metric_outputs(),
        rule_outputs(),
        dashboard_outputs(),
        _nms_outputs(DEFAULT_ROOT),
    )


def own_outputs(root: Oid) -> dict[str, str]:
    """The files that name the enterprise root, with another one: the MIB modules and what is for an NMS."""
    made = _together(mib_outputs(root), _nms_outputs(root))
    del made[LOCK]  # it is about the numbers below the root
    return made


def _nms_outputs(root: Oid) -> dict[str, str]:
    return _together(
        exporter_outputs(root),
        librenms_outputs(root),
        snmpd_outputs(root),
        telegraf_outputs(root),
        zabbix_outputs(root),
    )


def _together(*parts: Mapping[str, str]) -> dict[str, str]:
    made: dict[str, str] = {}
    for part in parts:
        for path, text in part.items():
            if path in made:
                raise ValueError(f"{path} is made twice")
            made[path] = text
    return dict(sorted(made.items()))


def write(root: Path, made: dict[str, str] | None = None) -> list[str]:
    """Write what differs under `root` and remove pages of models that are gone; returns the paths touched."""
    made = outputs() if made is None else made
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
    pages = {path for path in made if path.startswith(_PAGES)}
    left_over = {f"{_PAGES}{page.name}" for page in (root / _PAGES).glob("*.md")} - pages if pages else set()
    return sorted([*differing, *left_over])


def _read(path: Path) -> str | None:
    try:
        return path.read_bytes().decode("utf-8")
    except (FileNotFoundError, UnicodeDecodeError):
        return None
