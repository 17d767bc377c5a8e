"""Every code block of the README and the docs does what it says.

Configuration is loaded, commands are run against a gateway over simulated lines, queries are parsed by Prometheus. For
a command that changes the machine or needs another one, ELSEWHERE names the test that runs it instead. A new kind of
block or command fails here until somebody says how it is run.
"""

from __future__ import annotations

import os
import re
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from gateway.errors import ConfigError
from gateway.service.config import load_config
from tests.docs.blocks import ROOT, Block, blocks
from tests.e2e.fast_lines import BAUDRATE
from tests.e2e.programs import DEMO_DEVICES, GATEWAY, Program, Running, wait_until, write_config
from tests.ports import free_port

ALL = list(blocks())
SHELL = [block for block in ALL if block.kind in {"", "sh"}]

ELSEWHERE = {
    r"make demo": "tests/e2e/test_demo.py",
    r"make (test|setup|help|bench|test-long)": ".ci/run",
    r"docker compose ": "tests/deploy/test_files.py",  # there is no registry to fetch its images from
    r"prometheus --config": "tests/deploy/conftest.py",
    r"prometheus-snmp-exporter ": "tests/deploy/nms/test_snmp_exporter.py",
    r"(deploy/install.sh|cp site.toml /etc)": "tests/deploy/test_install.py",
    r"(apt-get install|systemctl|journalctl|editor|ls -l /dev/serial)": "tests/deploy/test_install.py",
    r"python (-m tests.fuzz.corpus|tests/fuzz/fuzz_)": "tests/fuzz/test_fuzz.py",
    r"podman ": "tests/deploy/test_image.py",
    r"prostar-gateway scan ": "tests/cli/test_scan.py",
    r"prostar-gateway simulate --tcp": "tests/simulator/test_simulate.py",
}
"""Commands that change the machine they run on or take one with more on it, and where they are run instead."""

OF_ANOTHER_TEST = {
    ("docs/tls.md", "sh"): "tests/faces/modbus/tls/site.py",  # makes its certificates with exactly these commands
}
"""Blocks that another test reads from their page."""


def ids(block: Block) -> str:
    return str(block)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    """The demo's controllers and a gateway that has read a year of days from one of them."""
    folder = tmp_path_factory.mktemp("docs")
    ports = (free_port(socket.SOCK_STREAM), free_port(socket.SOCK_DGRAM), free_port(socket.SOCK_STREAM))
    programs = []
    try:
        programs.append(Program((sys.executable, "-m", "tests.e2e.fast_lines", str(folder), "plants")))
        wait_until((folder / "shelter-b").exists, "the simulated lines")
        write_config(folder / "site.toml", ports, line_keys=f"baudrate = {BAUDRATE}")
        programs.append(Program((*GATEWAY, "run", "-c", str(folder / "site.toml"))))
        running = Running(folder, *ports, programs[1], programs[0])
        running.wait_online(*(name for _, name, _, _ in DEMO_DEVICES))
        programs[1].wait_for(r'event=history_harvested device="array-1"', 60)
        yield running
    finally:
        for each in reversed(programs):
            each.end()


def test_every_kind_of_block_has_somebody_who_runs_it() -> None:
    assert {block.kind for block in ALL} <= {"", "sh", "toml", "text", "promql", "yaml"}
    assert len(ALL) > 20


@pytest.mark.parametrize("block", [block for block in ALL if block.kind == "toml"], ids=ids)
def test_configuration_is_right(block: Block, tmp_path: Path) -> None:
    text = block.text
    if "[[line]]" not in text:
        write_config(tmp_path / "base.toml", (1502, 1161, 9850))
        base = (tmp_path / "base.toml").read_text()
        for table in re.findall(r"^\[\w[\w.]*\]$", text, re.MULTILINE):  # what the block brings itself
            base = re.sub(rf"^{re.escape(table)}\n(?:(?!\[).*\n)*", "", base, flags=re.MULTILINE)
        text = base + text
    path = tmp_path / "block.toml"
    path.write_text(text)
    try:
        load_config(path)
    except ConfigError as error:
        pytest.fail("\n".join(error.problems))


@pytest.mark.parametrize("block", [block for block in ALL if block.kind == "text"], ids=ids)
def test_what_a_program_is_said_to_show_it_shows(block: Block, tmp_path: Path) -> None:
    {"problems": shows_the_problems, "demo": shows_the_screen}[block.name](block, tmp_path)


def shows_the_problems(block: Block, tmp_path: Path) -> None:
    """The lines of check-config for a file with these two mistakes, but for what "…" stands for."""
    devices = (("shelter-a", "array-1", 1, 11), ("shelter-a", "array-2", 2, 300))
    write_config(tmp_path / "site.toml", (1502, 1161, 9850), devices, modbus_keys="max_conections = 3")
    done = subprocess.run(
        [*GATEWAY, "check-config", "-c", "site.toml"],
        capture_output=True,
        text=True,
        check=False,
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    for line in block.text.splitlines():
        shown = re.escape(line).replace("…", ".*")
        assert re.search(rf"^{shown}$", done.stderr, re.MULTILINE), f"{line}\nis not in\n{done.stderr}"


def shows_the_screen(block: Block, _folder: Path) -> None:
    """The demo's own headings and states; its numbers are another day's."""
    source = (ROOT / "gateway" / "cli" / "demo_screen.py").read_text()
    headings = {"device", "charge", "unit", "battery", "array", "load", "age", "quality", "port", "use", "errors"}
    words = set(re.findall(r"[a-z]+", block.text))
    assert headings <= words
    for heading in headings:
        assert re.search(rf'["n]{heading}\b', source), heading
    for _, name, _, unit in DEMO_DEVICES:
        assert re.search(rf"^ +{unit} +{name}\b", block.text, re.MULTILINE)


@pytest.mark.peer
@pytest.mark.parametrize("block", [block for block in ALL if block.kind == "promql"], ids=ids)
def test_prometheus_can_read_a_query(block: Block, peer: Callable[[str], str], tmp_path: Path) -> None:
    rules = tmp_path / "rules.yml"
    rules.write_text(
        "groups:\n- name: docs\n  rules:\n"
        + "".join(
            f"  - record: docs:query{number}\n    expr: |\n      {line}\n"
            for number, line in enumerate(block.text.strip().splitlines())
        )
    )
    done = subprocess.run([peer("promtool"), "check", "rules", str(rules)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.peer
@pytest.mark.parametrize("block", [block for block in ALL if block.kind == "yaml"], ids=ids)
def test_prometheus_takes_a_configuration(block: Block, peer: Callable[[str], str], tmp_path: Path) -> None:
    config = tmp_path / "prometheus.yml"
    config.write_text(block.text)
    done = subprocess.run(
        [peer("promtool"), "check", "config", str(config)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.parametrize("block", SHELL, ids=ids)
def test_the_shell_can_read_it(block: Block) -> None:
    done = subprocess.run(["bash", "-n"], input=block.text, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.peer
@pytest.mark.parametrize("block", SHELL, ids=ids)
def test_commands_work_as_printed(
    block: Block, peer: Callable[[str], str], tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    if (block.page, block.kind) in OF_ANOTHER_TEST:
        source = (ROOT / OF_ANOTHER_TEST[block.page, block.kind]).read_text()
        assert Path(block.page).name in source
        return
    for command in block.commands():
        elsewhere = [test for pattern, test in ELSEWHERE.items() if re.match(pattern, command)]
        if elsewhere:
            assert (ROOT / elsewhere[0]).exists()
            if command.startswith("make"):
                dry = subprocess.run(["make", "-n", *command.split()[1:2]], cwd=ROOT, capture_output=True, check=False)
                assert dry.returncode == 0
        elif command.startswith(".venv/bin/prostar-gateway generate"):
            assert run(tmp_path, f"{command.partition('#')[0]} --check") == ""
        elif program := re.match(r"\.venv/bin/python (?:-m )?(tests[./](?:bench|fuzz)[./]\S+)", command):
            assert (ROOT / (program[1].removesuffix(".py").replace(".", "/") + ".py")).is_file()
            run(tmp_path, f"{command} --help")
        else:
            for foreign in ("curl", "snmpwalk", "promtool", "mbpoll"):
                if foreign in command:
                    peer(foreign)
            shown = run(tmp_path, on_the(request.getfixturevalue("site"), command, tmp_path))
            assert shown or ">" in command, f"{command}: shows nothing"


def on_the(site: Running, command: str, folder: Path) -> str:
    """The command with the site's own addresses and files; of the history two weeks, for promtool takes its time."""
    config = str(site.folder / "site.toml")
    command = re.sub(r"-c (/etc/prostar-gateway/site\.toml|site\.toml|FILE)", f"-c {config}", command)
    for printed, port in ((1502, site.modbus), (1161, site.snmp), (9850, site.http)):
        command = command.replace(f"127.0.0.1:{printed}", f"127.0.0.1:{port}").replace(f"-p {printed} ", f"-p {port} ")
    if "prostar-gateway restore" in command:  # nothing is restored below a gateway that runs
        (folder / "other.toml").write_text(Path(config).read_text().replace("/state", "/other-state"))
        command = command.replace(config, str(folder / "other.toml"))
        archive = folder.parent / "prostar-gateway.tar"
        run(folder, f"prostar-gateway backup -c {config} {archive}")
    since = (datetime.now(UTC) - timedelta(days=14)).date()
    command = command.replace("--format openmetrics", f"--format openmetrics --since {since}")
    command = command.replace("/root/prostar-gateway.tar", str(folder.parent / "prostar-gateway.tar"))
    return command.replace("/var/lib/prometheus/data", str(folder / "data")).replace("days.om", str(folder / "days.om"))


def run(folder: Path, command: str) -> str:
    """Run it in the clone, as somebody with the environment in PATH does; gives what it shows."""
    done = subprocess.run(
        ["bash", "-euo", "pipefail", "-c", command.replace(".venv/bin/", "")],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
        env={
            **os.environ,
            "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}:/usr/sbin",
            "PYTHONPATH": str(ROOT),
            "SNMPCONFPATH": "/nonexistent",
            "TMPDIR": str(folder),
        },
    )
    assert done.returncode == 0, f"{command}\n{done.stdout[-2000:]}\n{done.stderr[-2000:]}"
    return done.stdout + done.stderr
