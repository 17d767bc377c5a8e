"""The Containerfile cannot be built where there is no registry; what can be known about it without one is."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
FILE = ROOT / "deploy" / "Containerfile"


def instructions() -> list[tuple[str, str]]:
    """Keyword and arguments of each instruction, continued lines joined."""
    bare = re.sub(r"^#.*\n", "", FILE.read_text(), flags=re.MULTILINE).replace("\\\n", " ")
    return [(word, rest) for word, _, rest in (line.partition(" ") for line in bare.splitlines() if line)]


def arguments(keyword: str) -> list[str]:
    return [rest for word, rest in instructions() if word == keyword]


def allowed() -> list[str]:
    """What .dockerignore lets into the build."""
    lines = (ROOT / ".dockerignore").read_text().splitlines()
    assert "*" in lines
    return [line[1:] for line in lines if line.startswith("!")]


def test_it_knows_only_real_instructions() -> None:
    known = {"FROM", "RUN", "WORKDIR", "COPY", "USER", "VOLUME", "STOPSIGNAL", "ENTRYPOINT", "CMD"}
    assert {word for word, _ in instructions()} <= known


def test_what_it_copies_is_there_and_let_in() -> None:
    copied = [name for rest in arguments("COPY") if "--from" not in rest for name in rest.split()[:-1]]
    assert sorted(copied) == sorted(allowed())
    assert all((ROOT / name).exists() for name in copied)


def test_what_building_the_project_reads_is_copied() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert {project["readme"], *project["license-files"]} <= set(allowed())


def test_it_installs_what_is_locked() -> None:
    installs = [part for rest in arguments("RUN") for part in rest.split("&&") if "pip install" in part]
    assert ["--require-hashes" in part or "--no-deps" in part for part in installs] == [True, True]


def test_it_does_not_run_as_root() -> None:
    last = [index for index, (word, _) in enumerate(instructions()) if word == "FROM"][-1]
    assert ("USER", "prostar-gateway") in instructions()[last:]


def test_it_runs_what_the_service_runs() -> None:
    unit = (ROOT / "deploy" / "systemd" / "prostar-gateway.service").read_text()
    (start,) = re.findall(r"^ExecStart=\S+ (.*)$", unit, re.MULTILINE)
    (command,) = arguments("CMD")
    assert re.findall(r'"(.*?)"', command) == start.split()


@pytest.mark.parametrize("path", ["/etc/prostar-gateway", "/var/lib/prostar-gateway"])
def test_its_head_mounts_configuration_and_state(path: str) -> None:
    assert re.search(rf"^# .*-v \S+:{path}(:ro)?( |$)", FILE.read_text(), re.MULTILINE)
