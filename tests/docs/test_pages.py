"""The pages that promise: every proof they name is there, and what has none says so."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.docs.blocks import ROOT, pages

NAMED = sorted(
    {
        (str(page.relative_to(ROOT)), path, name)
        for page in pages()
        for path, name in re.findall(r'\[test\]\((\S+) "(\w+)"\)', page.read_text(encoding="utf-8"))
    }
)


def rows(page: str) -> list[list[str]]:
    """The cells of every table row of a page but the heads."""
    found = []
    lines = (ROOT / page).read_text(encoding="utf-8").splitlines()
    for line, below in zip(lines, [*lines[1:], ""], strict=True):
        if line.startswith("| ") and not below.startswith("|---") and not set(line) <= set("|- "):
            found.append([cell.strip() for cell in line.strip("|").split(" | ")])
    return found


def test_there_are_proofs() -> None:
    assert len(NAMED) > 150


@pytest.mark.parametrize(("page", "path", "name"), NAMED)
def test_a_named_test_exists(page: str, path: str, name: str) -> None:
    source = (ROOT / page).parent / path
    assert source.is_file(), page
    assert re.search(rf"def {name}\(", source.read_text(encoding="utf-8")), f"{page}: {path} has no {name}"


def test_every_row_of_the_compliance_page_has_a_proof_or_is_not_there() -> None:
    found = rows("docs/compliance.md")
    assert len(found) > 40
    for cells in found:
        assert "[test](" in cells[-1] or any("**not there:**" in cell for cell in cells), cells


def test_the_compliance_page_names_every_specification() -> None:
    text = (ROOT / "docs" / "compliance.md").read_text(encoding="utf-8")
    for name in ("V1.1b3", "V1.02", "V1.0b", "V3.6", "0.0.4", "OpenMetrics 1.0"):
        assert re.search(rf"^## .*{re.escape(name)}", text, re.MULTILINE), name
    for number in (3411, 3412, 3414, 3415, 3416, 3417, 3418, 3826, 7860, 4133, 3433):
        assert f"RFC {number}" in text


def test_every_threat_has_something_in_its_way() -> None:
    threats = [
        cells for cells in rows("docs/security.md") if len(cells) == 2 and cells[0].startswith(("some", "any", "a "))
    ]
    assert len(threats) > 10
    assert [cells[0] for cells in threats if "[test](" not in cells[1]] == []


@pytest.mark.peer
def test_the_exposure_on_the_page_is_systemds(peer: Callable[[str], str]) -> None:
    unit = ROOT / "deploy" / "systemd" / "prostar-gateway.service"
    done = subprocess.run(
        [peer("systemd-analyze"), "security", "--offline=yes", "--no-pager", str(unit)],
        capture_output=True,
        text=True,
        check=True,
    )
    found = re.search(r"Overall exposure level for \S+: ([\d.]+)", done.stdout)
    assert found is not None
    assert f"gives it {found[1]} of 10" in Path(ROOT / "docs" / "install.md").read_text(encoding="utf-8")
