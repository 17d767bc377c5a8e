"""A real Prometheus that scrapes a real gateway over simulated lines, by the configuration that is delivered."""

from __future__ import annotations

import json
import socket
import struct
import subprocess
import time
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from tests.deploy.promtool import REPOSITORY, RULES
from tests.e2e.conftest import start
from tests.e2e.programs import GATEWAY, MIXED_DEVICES, Program, wait_until, write_config
from tests.ports import free_port

__all__ = ["start"]

SERVING_S = 20.0


@dataclass(frozen=True)
class Server:
    """A running Prometheus."""

    url: str

    def ask(self, path: str, **parameters: str) -> Any:
        """The data of a query of its API; AssertionError with what it says when it refuses."""
        query = urllib.parse.urlencode(parameters)
        try:
            with urllib.request.urlopen(f"{self.url}/api/v1/{path}?{query}", timeout=60) as reply:
                return json.load(reply)["data"]
        except urllib.error.HTTPError as error:
            with error:
                raise AssertionError(f"{parameters}: {error.read().decode()}") from None

    def query(self, expr: str) -> list[dict[str, Any]]:
        """The series of an expression now."""
        found: list[dict[str, Any]] = self.ask("query", query=expr)["result"]
        return found


def _answers(url: str) -> bool:
    try:
        with urllib.request.urlopen(url, timeout=1) as reply:
            return bool(reply.status == 200)
    except urllib.error.HTTPError as error:
        error.close()
        return False
    except OSError:
        return False


def read_past_the_polls(port: int) -> None:
    """A Modbus client's read of the daily log, which only the line can answer."""
    with socket.create_connection(("127.0.0.1", port), timeout=60) as client:
        client.sendall(struct.pack(">HHHBBHH", 1, 0, 6, 11, 3, 0x8000, 16))
        assert len(client.recv(300)) == 9 + 32


@pytest.fixture(scope="module")
def server(peer: Callable[[str], str], tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """A Prometheus with the delivered configuration (scrapes twice a second) and some seconds of a site."""
    program, folder = peer("prometheus"), tmp_path_factory.mktemp("site")
    gateway = [free_port(socket.SOCK_STREAM), free_port(socket.SOCK_DGRAM), free_port(socket.SOCK_STREAM)]
    port = free_port(socket.SOCK_STREAM)
    config = (REPOSITORY / "deploy" / "prometheus" / "prometheus.yml").read_text(encoding="utf-8")
    (folder / "rules").mkdir()
    for rules in RULES:
        (folder / "rules" / rules.name).write_bytes(rules.read_bytes())
    (folder / "prometheus.yml").write_text(
        config.replace("15s", "500ms").replace("127.0.0.1:9850", f"127.0.0.1:{gateway[2]}"), encoding="utf-8"
    )
    started: list[Program] = []
    with (folder / "log").open("wb") as log:
        try:
            started.append(Program((*GATEWAY, "simulate", "--link-dir", str(folder))))
            wait_until(lambda: any(path.is_symlink() for path in folder.iterdir()), "the simulated lines")
            write_config(folder / "site.toml", (gateway[0], gateway[1], gateway[2]), MIXED_DEVICES)
            started.append(Program((*GATEWAY, "run", "-c", str(folder / "site.toml"))))
            # Prometheus asks for targets when it starts, and then only once in a while.
            wait_until(lambda: _answers(f"http://127.0.0.1:{gateway[2]}/readyz"), "the gateway", SERVING_S)
            process = subprocess.Popen(
                [
                    program,
                    f"--config.file={folder / 'prometheus.yml'}",
                    f"--storage.tsdb.path={folder / 'data'}",
                    f"--web.listen-address=127.0.0.1:{port}",
                ],
                stdout=log,
                stderr=log,
            )
            try:
                found = Server(f"http://127.0.0.1:{port}")
                wait_until(lambda: _answers(f"{found.url}/-/ready"), "Prometheus", SERVING_S)
                wait_until(lambda: len(found.query("morningstar_up == 1")) == 4, "all controllers", SERVING_S)
                read_past_the_polls(gateway[0])
                counted = "sum(prostar_gateway_line_client_seconds_total) > 0"
                wait_until(lambda: found.query(counted), "the client's read", SERVING_S)
                began = time.time()
                scraped = f"timestamp(prostar_gateway_ready) > {began + 3}"
                wait_until(lambda: found.query(scraped), "some more scrapes", SERVING_S)
                yield found
            finally:
                process.terminate()
                process.wait(60)
        finally:
            for each in reversed(started):
                each.end()


@pytest.fixture(scope="session")
def delivered() -> Path:
    """The folder with everything that is delivered."""
    return REPOSITORY / "deploy"
