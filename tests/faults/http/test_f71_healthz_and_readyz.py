"""F71: /healthz says that the loop is alive, /readyz that what is configured listens; a dead controller is neither."""

from __future__ import annotations

import socket
import urllib.request
from pathlib import Path

import pytest

from tests.e2e.programs import Launch, StandsStill, wait_until


def test_dead_controllers_and_missing_ports_are_ready(launch: Launch) -> None:
    site = launch(simulate=None)  # no line at all: every port is missing
    wait_until(lambda: site.get("/readyz")[0], "the HTTP face")
    wait_until(lambda: site.get("/readyz") == (200, "ready\n"), "readiness")
    assert site.get("/healthz") == (200, "ok\n")
    assert set(site.up().values()) == {0.0}


def test_a_controller_that_dies_changes_neither(launch: Launch) -> None:
    site = launch()
    site.wait_online()
    assert site.simulator is not None
    site.simulator.end()
    wait_until(lambda: set(site.up().values()) == {0.0}, "every controller away", 30.0)
    assert (site.get("/healthz")[0], site.get("/readyz")[0]) == (200, 200)


def test_a_face_that_cannot_listen_is_not_ready_and_named(launch: Launch) -> None:
    with socket.create_server(("127.0.0.1", 0)) as holder:
        taken = f"127.0.0.1:{holder.getsockname()[1]}"
        site = launch(simulate=None, modbus_keys=f'[[modbus.listener]]\nline = "shelter-a"\nlisten = ["{taken}"]\n')
        wait_until(lambda: site.get("/readyz")[0] == 503, "the HTTP face")
        assert f"modbus {taken}" in site.get("/readyz")[1]
        assert site.get("/healthz")[0] == 200
        assert "prostar_gateway_ready 0.0" in site.get("/metrics")[1]
    wait_until(lambda: site.get("/readyz")[0] == 200, "the freed address", 30.0)


def test_a_loop_that_hangs_is_not_healthy_whatever_other_threads_do(launch: Launch, tmp_path: Path) -> None:
    still = StandsStill(tmp_path)
    site = launch(simulate=None, command=still.command)
    wait_until(lambda: site.get("/healthz")[0] == 200, "the HTTP face")
    site.gateway.process.send_signal(still.SIGNAL)
    site.gateway.wait_for(still.SAID)
    with pytest.raises(TimeoutError):
        urllib.request.urlopen(f"http://127.0.0.1:{site.http}/healthz", timeout=0.3)
    still.go_on()
    wait_until(lambda: site.get("/healthz")[0] == 200, "the loop again")
    assert site.gateway.end() == 0
