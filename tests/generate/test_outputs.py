from __future__ import annotations

from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

from gateway.cli import generate
from gateway.devices.schema import models
from gateway.errors import MapError
from gateway.generate import outputs

REPOSITORY = Path(__file__).parents[2]

app = typer.Typer()
app.command()(generate.command)


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    outputs.write(tmp_path)
    return tmp_path


def test_committed_files_are_what_the_maps_say() -> None:
    assert outputs.check(REPOSITORY) == []


def test_every_part_is_made() -> None:
    made = outputs.outputs()
    assert {"docs/metrics.md", "mibs/PROSTAR-GATEWAY-MIB.txt", "mibs/oids.lock"} <= made.keys()
    assert {f"docs/registers/{model}.md" for model in models()} <= made.keys()
    for path, text in made.items():
        assert text.endswith("\n"), path
        assert "\r" not in text, path


def test_made_twice_is_the_same() -> None:
    assert outputs.outputs() == outputs.outputs()


def test_what_was_written_has_no_difference(tree: Path) -> None:
    assert outputs.check(tree) == []
    assert outputs.write(tree) == []


def test_check_finds_every_kind_of_difference(tree: Path) -> None:
    metrics = tree / "docs" / "metrics.md"
    metrics.write_text(metrics.read_text(encoding="utf-8").replace("gauge", "guage", 1), encoding="utf-8")
    (tree / "docs" / "registers" / "prostar-mppt.md").unlink()
    (tree / "docs" / "registers" / "tristar-pwm.md").write_text("gone", encoding="utf-8")
    (tree / "mibs" / "oids.lock").write_bytes(b"\xff\xfe")
    expected = ["docs/metrics.md", "docs/registers/prostar-mppt.md", "docs/registers/tristar-pwm.md", "mibs/oids.lock"]
    assert outputs.check(tree) == expected
    assert outputs.write(tree) == expected
    assert outputs.check(tree) == []


def test_a_changed_line_ending_is_a_difference(tree: Path) -> None:
    metrics = tree / "docs" / "metrics.md"
    metrics.write_bytes(metrics.read_bytes().replace(b"\n", b"\r\n"))
    assert outputs.check(tree) == ["docs/metrics.md"]


def test_command_names_the_files_that_differ(tree: Path) -> None:
    (tree / "docs" / "metrics.md").write_text("old", encoding="utf-8")
    result = CliRunner().invoke(app, ["--check", "--root", str(tree)])
    assert result.exit_code == 1
    assert result.stdout == "differs docs/metrics.md\n"
    assert "prostar-gateway generate" in result.stderr
    assert (tree / "docs" / "metrics.md").read_text(encoding="utf-8") == "old", "--check writes nothing"


def test_command_writes_then_checks_clean(tree: Path) -> None:
    (tree / "docs" / "metrics.md").write_text("old", encoding="utf-8")
    result = CliRunner().invoke(app, ["--root", str(tree)])
    assert (result.exit_code, result.stdout) == (0, "written docs/metrics.md\n")
    result = CliRunner().invoke(app, ["--check", "--root", str(tree)])
    assert (result.exit_code, result.stdout) == (0, "")


def test_command_says_which_map_is_wrong(tree: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse() -> dict[str, str]:
        raise MapError("prostar-mppt.toml: point x: no")

    monkeypatch.setattr(outputs, "register_outputs", refuse)
    result = CliRunner().invoke(app, ["--check", "--root", str(tree)])
    assert result.exit_code == 1
    assert "prostar-mppt.toml: point x: no" in result.stderr


def test_command_refuses_a_root_that_is_not_there(tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["--root", str(tmp_path / "none")])
    assert result.exit_code == 2


def test_an_operators_own_root_is_in_every_file_that_names_one(tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["--enterprise-root", "1.3.6.1.4.1.99999.7", "--root", str(tmp_path)])
    assert result.exit_code == 0
    written = {str(path.relative_to(tmp_path)): path.read_text(encoding="utf-8") for path in tmp_path.rglob("*.*")}
    assert {path for path in outputs.outputs() if path.startswith(("deploy/nms/", "mibs/"))} - written.keys() == {
        "mibs/oids.lock"
    }
    assert all(path.startswith(("deploy/nms/", "mibs/")) for path in written)
    assert [path for path, text in written.items() if "32473" in text] == []
    assert [path for path, text in written.items() if path.startswith("deploy") and ".99999.7" not in text] == []
    again = CliRunner().invoke(app, ["--enterprise-root", "1.3.6.1.4.1.99999.7", "--check", "--root", str(tmp_path)])
    assert (again.exit_code, again.stdout) == (0, "")


@pytest.mark.parametrize("wrong", ["1.3.6.1.2.1", "99999", "1.3.6.1.4.1.33333.1", "1.3.6.1.4.1"])
def test_a_root_that_is_not_the_operators_is_refused(tmp_path: Path, wrong: str) -> None:
    result = CliRunner().invoke(app, ["--enterprise-root", wrong, "--root", str(tmp_path)])
    assert result.exit_code == 2
    assert list(tmp_path.iterdir()) == []
