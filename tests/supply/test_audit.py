"""Licences of what is locked, and that an audit that could not be made is no success."""

from __future__ import annotations

import json
from importlib.metadata import Distribution, PathDistribution
from pathlib import Path

import pytest

from tests.docs.blocks import ROOT
from tests.supply.audit import Package, judge, licence_of, packages, table
from tests.supply.locked import locked

LOCK = ROOT / "requirements.txt"
HOLE = {"id": "PYSEC-1", "fix_versions": ["1.2"], "aliases": [], "description": ""}


def report(*entries: dict[str, object]) -> str:
    return json.dumps({"dependencies": entries, "fixes": []})


def test_every_library_has_a_licence_that_lets_a_site_use_it() -> None:
    found = packages(LOCK)
    assert {each.name for each in found} == set(locked(LOCK))
    assert [each for each in found if not each.allowed] == []


def test_the_list_has_a_row_for_each() -> None:
    found = packages(LOCK)
    assert [f"| {each.name} | {each.version} | {each.licence} |" in table(found) for each in found] == [True] * len(
        found
    )


@pytest.mark.parametrize(
    ("metadata", "licence"),
    [
        ("License-Expression: Apache-2.0 OR BSD-3-Clause\n", "Apache-2.0 OR BSD-3-Clause"),
        ("License: MIT\n", "MIT"),
        ("Classifier: License :: OSI Approved :: BSD License\nLicense: whatever\n", "BSD-3-Clause"),
        ("Classifier: License :: OSI Approved\nLicense: BSD-2-Clause\n", "BSD-2-Clause"),
        ("License: All rights reserved\n", ""),
        ("", ""),
    ],
)
def test_a_licence_is_read_from_any_age_of_metadata(tmp_path: Path, metadata: str, licence: str) -> None:
    (tmp_path / "x-1.dist-info").mkdir()
    (tmp_path / "x-1.dist-info" / "METADATA").write_text(f"Metadata-Version: 2.4\nName: x\nVersion: 1\n{metadata}")
    found: Distribution = PathDistribution(tmp_path / "x-1.dist-info")
    assert licence_of(found) == licence


@pytest.mark.parametrize(
    ("licence", "allowed"),
    [
        ("MIT", True),
        ("GPL-3.0-only", False),
        ("GPL-3.0-only OR MIT", True),
        ("MIT AND PSF-2.0", True),
        ("MIT AND GPL-3.0-only", False),
        ("", False),
    ],
)
def test_which_licences_may_be_used(licence: str, allowed: bool) -> None:
    assert Package("x", "1", licence).allowed is allowed


@pytest.mark.parametrize(
    ("text", "status"),
    [
        (report({"name": "a", "version": "1", "vulns": []}), 0),
        (report({"name": "a", "version": "1", "vulns": [HOLE]}), 1),
        (report({"name": "a", "version": "1", "vulns": []}, {"name": "b", "skip_reason": "not found"}), 3),
        (report({"name": "a", "version": "1", "vulns": [HOLE]}, {"name": "b", "skip_reason": "not found"}), 1),
        (report(), 3),
        ("", 3),
        ("[]", 3),
    ],
    ids=["clean", "hole", "one not asked", "hole and one not asked", "nothing", "no report", "strange report"],
)
def test_an_audit_that_could_not_be_made_is_no_success(text: str, status: int) -> None:
    assert judge(text)[0] == status


def test_a_hole_is_named_with_the_version_that_mends_it() -> None:
    said = judge(report({"name": "a", "version": "1", "vulns": [HOLE]}))[1]
    assert "a 1: PYSEC-1, mended in 1.2" in said
