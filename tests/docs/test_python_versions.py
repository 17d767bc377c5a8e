"""Which versions of Python it is for: one list, wherever it is written; and `make PYTHON=…` takes the one it names."""

from __future__ import annotations

import re
import shutil
import subprocess
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
VERSIONS = ["3.11", "3.12", "3.13", "3.14"]


def test_the_package_names_them() -> None:
    classifiers = [each for each in PROJECT["classifiers"] if each.startswith("Programming Language :: Python :: 3.")]
    assert [each.rpartition(" ")[2] for each in classifiers] == VERSIONS
    assert PROJECT["requires-python"] == f">={VERSIONS[0]}"


@pytest.mark.parametrize("file", ["Makefile", "deploy/install.sh"])
def test_each_is_looked_for(file: str) -> None:
    [candidates] = re.findall(r"for candidate in .*PYTHON.*", (ROOT / file).read_text(encoding="utf-8"))
    assert re.findall(r"python(3\.\d+)", candidates) == VERSIONS


@pytest.fixture
def clone(tmp_path: Path) -> Path:
    """The Makefile with an environment that is current and was made by `old`, a Python that only says who it is."""
    for file in ("Makefile", "pyproject.toml", "requirements.txt", "requirements-dev.txt", "requirements-audit.txt"):
        shutil.copy2(ROOT / file, tmp_path)
    (tmp_path / ".venv" / "bin").mkdir(parents=True)
    for path, name in (("old", "old"), ("new", "new"), (".venv/bin/python", "old")):
        (tmp_path / path).write_text(f"#!/bin/sh\necho {name}\n")
        (tmp_path / path).chmod(0o755)
    for path in (".venv/.dev", ".venv/.runtime", ".venv-audit/.ready"):
        (tmp_path / path).parent.mkdir(exist_ok=True)
        (tmp_path / path).touch()
    return tmp_path


def ask_make(clone: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    environment = {"PATH": "/usr/bin:/bin"}  # no MAKEFLAGS of a `make test` above
    return subprocess.run(["make", *arguments], cwd=clone, env=environment, capture_output=True, text=True, check=False)


@pytest.mark.parametrize("environment", [".venv/.dev", ".venv/.runtime", ".venv-audit/.ready"])
@pytest.mark.parametrize(
    ("named", "current"), [((), True), (("PYTHON=./old",), True), (("PYTHON=./new",), False), (("PYTHON=./no",), False)]
)
def test_another_python_is_not_taken_for_the_one_that_is_there(
    clone: Path, environment: str, named: tuple[str, ...], current: bool
) -> None:
    asked = ask_make(clone, "--question", *named, environment)
    assert (asked.returncode, asked.stderr) == (0 if current else 1, "")


def test_a_python_that_is_named_in_a_fresh_clone_is_taken_without_a_word(clone: Path) -> None:
    shutil.rmtree(clone / ".venv")
    told = ask_make(clone, "--dry-run", "PYTHON=./new", "setup")
    assert (told.returncode, told.stderr) == (0, "")
    assert "in ./new;" in told.stdout
