"""The Containerfile and what runs its image, as far as reading tells; test_image.py builds and runs it."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest

from tests.docs.blocks import blocks

ROOT = Path(__file__).parents[2]
FILE = ROOT / "deploy" / "Containerfile"
QUADLET = ROOT / "deploy" / "quadlet" / "prostar-gateway.container"


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
    known = {
        *("FROM", "RUN", "WORKDIR", "COPY", "ENV", "USER", "VOLUME", "STOPSIGNAL", "HEALTHCHECK", "ENTRYPOINT", "CMD")
    }
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


def test_it_runs_as_the_user_whose_number_the_page_names() -> None:
    last = [index for index, (word, _) in enumerate(instructions()) if word == "FROM"][-1]
    [user] = [rest for word, rest in instructions()[last:] if word == "USER"]
    assert re.fullmatch(r"[1-9][0-9]+", user), "a number, for engines that have to know that it is not root"
    assert f"useradd --uid {user} " in FILE.read_text()
    assert f"chown {user} " in (ROOT / "docs" / "container.md").read_text()


def test_it_runs_what_the_service_runs() -> None:
    unit = (ROOT / "deploy" / "systemd" / "prostar-gateway.service").read_text()
    (start,) = re.findall(r"^ExecStart=\S+ (.*)$", unit, re.MULTILINE)
    (command,) = arguments("CMD")
    assert re.findall(r'"(.*?)"', command) == start.split()


def test_its_health_is_asked_for_by_the_same_file() -> None:
    [check], [command] = arguments("HEALTHCHECK"), arguments("CMD")
    asked = re.findall(r'"(.*?)"', check)
    assert asked[:2] == ["prostar-gateway", "health"]
    assert asked[2:] == re.findall(r'"(.*?)"', command)[1:]
    assert f"HealthCmd={' '.join(asked)}\n" in QUADLET.read_text()


def options() -> list[str]:
    """What the page has `podman run` be told, the image left out."""
    [block] = [block for block in blocks() if block.name == "image-run"]
    [command] = block.commands()
    words = re.findall(r'"[^"]*"|\S+', command)
    assert words[:3] == ["podman", "run", "-d"]
    assert words[-1] == "prostar-gateway"
    return words[3:-1]


@pytest.mark.parametrize("path", ["/etc/prostar-gateway:ro", "/var/lib/prostar-gateway", "/dev"])
def test_the_page_mounts_configuration_state_and_devices(path: str) -> None:
    assert any(word.endswith(f":{path}") for word in options())


def test_the_quadlet_runs_what_the_page_runs() -> None:
    """Each option of the page is a key of the file, or stands in PodmanArgs."""
    text = QUADLET.read_text()
    keys = {
        "--name": "ContainerName={}",
        "--init": "RunInit=true",
        "--network": "Network={}",
        "--read-only": "ReadOnly=true",
        "--cap-drop": "DropCapability={}",
        "--security-opt": "NoNewPrivileges=true",
        "-v": "Volume={}",
    }
    words = options()
    while words:
        option = words.pop(0)
        value = words.pop(0) if words and not words[0].startswith("-") else ""
        if option in keys:
            assert f"\n{keys[option].format(value)}\n" in text
        else:
            assert re.search(rf"^PodmanArgs=.*{re.escape(option)} {re.escape(value)}", text, re.MULTILINE), option


def test_the_quadlet_logs_to_the_journal_that_the_gateway_knows_by_its_variable() -> None:
    text = QUADLET.read_text()
    assert "\nLogDriver=passthrough\nPodmanArgs=--env JOURNAL_STREAM\n" in text
    assert '"JOURNAL_STREAM"' in (ROOT / "gateway" / "service" / "log_writer.py").read_text()


def test_the_quadlet_ends_and_begins_as_the_service_does() -> None:
    unit = (ROOT / "deploy" / "systemd" / "prostar-gateway.service").read_text()
    for key in ("StartLimitIntervalSec", "Restart", "RestartSec", "RestartPreventExitStatus", "TimeoutStopSec"):
        [line] = re.findall(rf"^{key}=.*$", unit, re.MULTILINE)
        assert re.findall(rf"^{key}=.*$", QUADLET.read_text(), re.MULTILINE) == [line]
