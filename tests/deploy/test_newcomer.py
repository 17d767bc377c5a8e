"""From `make demo` to a first query with data: the commands of deploy/README.md, as they stand there.

A network namespace gives them the ports that they name, whatever else runs on the machine. Docker and Grafana are not
part of it; what Grafana would show is asked for in test_dashboards.py.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from tests.deploy.promtool import REPOSITORY
from tests.e2e.conftest import start
from tests.e2e.programs import Start, environment, wait_until
from tests.e2e.test_demo import Terminal

__all__ = ["start"]

pytestmark = [pytest.mark.peer, pytest.mark.timeout(120)]

README = (REPOSITORY / "deploy" / "README.md").read_text(encoding="utf-8")
MAKE_DEMO = "make demo"
DEBIANS_OWN = (sys.executable, "-m", "http.server", "--bind", "0.0.0.0", "9090")
"""In the place of the Prometheus that Debian's package starts when it is installed."""
NO_GRAPHS = "does not include the modern React web UI"
"""Debian's Prometheus says so at the addresses of others."""
FIRST_DATA_S = 40.0
"""The page promises values half a minute after the start."""


@dataclass(frozen=True)
class Machine:
    """A network of its own, where nothing else listens."""

    ip: str
    curl: str
    name: str

    def inside(self, *command: str) -> list[str]:
        """The command, to be run there."""
        return [self.ip, "netns", "exec", self.name, *command]

    def get(self, url: str) -> str:
        """A page, empty where there is none."""
        command = self.inside(self.curl, "-sL", "--fail", "--max-time", "5", url)
        return subprocess.run(command, capture_output=True, text=True, check=False, env=environment()).stdout

    def ask(self, prometheus: str, path: str) -> Any:
        """The data of a query of its API; None while there is no answer."""
        text = self.get(f"{prometheus}/api/v1/{path}")
        return json.loads(text)["data"] if text else None


@pytest.fixture
def machine(peer: Callable[[str], str]) -> Iterator[Machine]:
    made = Machine(peer("ip"), peer("curl"), f"pgwnew{os.getpid()}")
    added = subprocess.run([made.ip, "netns", "add", made.name], capture_output=True, text=True, check=False)
    if added.returncode != 0:
        pytest.skip(f"network namespaces are not permitted here: {added.stderr.strip()}")
    try:
        subprocess.run(made.inside(made.ip, "link", "set", "lo", "up"), check=True)
        yield made
    finally:
        subprocess.run([made.ip, "netns", "del", made.name], check=False)


@pytest.fixture
def demo(machine: Machine, tmp_path: Path) -> Iterator[Terminal]:
    """`make demo` on a terminal; the environment, which `make` would bring up to date, is the one that tests this."""
    assert f"```\n{MAKE_DEMO}\n```" in README
    make = MAKE_DEMO.replace("make", "make -o .venv/.runtime").split()
    terminal = Terminal(machine.inside(*make), 80, 24, tmp_path)
    yield terminal
    terminal.close()


def test_from_the_demo_to_the_first_graph(
    demo: Terminal, machine: Machine, start: Start, peer: Callable[[str], str], tmp_path: Path
) -> None:
    peer("prometheus")
    demo.wait_for(r"array-1(.|\n)*online(.|\n)*/readyz", timeout_s=30)
    [command] = re.findall(r"^prometheus .*$", README, re.MULTILINE)
    stored = re.search(r"--storage\.tsdb\.path=(\S+)", command)
    assert stored is not None
    start(*machine.inside(*DEBIANS_OWN))
    wait_until(lambda: machine.get("http://127.0.0.1:9090/"), "another program on port 9090")
    start(*machine.inside(*command.replace(stored[1], str(tmp_path / "stored")).split()))
    [graph] = re.findall(r"<(http://\S+/graph\?\S+)>", README)
    [alerts] = re.findall(r"<(http://\S+/alerts)>", README)
    prometheus, _, query = graph.partition("/classic/graph?g0.expr=")
    expr = query.partition("&")[0]

    def found() -> list[dict[str, Any]]:
        data = machine.ask(prometheus, f"query?query={expr}")
        return [] if data is None else list(data["result"])

    wait_until(found, f"data of {expr}", FIRST_DATA_S)
    shown = {each["metric"]["device"]: float(each["value"][1]) for each in found()}
    assert shown.keys() >= {"array-1", "array-2", "array-3"}
    assert all(10 < volts < 65 for volts in shown.values())
    for page in (graph, alerts):
        pages = [machine.get(page), machine.get(page.replace("/classic", ""))]
        assert any("<title>" in each and NO_GRAPHS not in each for each in pages), "in Debian's Prometheus or another"
    groups = machine.ask(prometheus, "rules")["groups"]
    assert {"MorningstarOffline", "ProstarGatewayDown"} <= {rule["name"] for group in groups for rule in group["rules"]}
    assert demo.interrupt() < 5.0
