"""The real thing: `simulate` and `run` as processes on real ptys and free ports, ended by their ids."""

from __future__ import annotations

import ssl
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import pytest

from tests.e2e.programs import DEMO_DEVICES, GATEWAY, MODELS, Launch, Program, Running, Start, wait_until, write_config


@pytest.fixture
def start() -> Iterator[Start]:
    """`start(*arguments)` starts a program; every one that still runs at the end of the test is ended."""
    programs: list[Program] = []

    def starter(*arguments: str) -> Program:
        programs.append(Program(arguments))
        return programs[-1]

    yield starter
    for program in reversed(programs):
        if program.process.returncode is None:
            program.end()


@pytest.fixture
def launch(tmp_path: Path, start: Start, free_tcp_port: Callable[[], int], free_udp_port: Callable[[], int]) -> Launch:
    """`launch(simulate=…, devices=…)` starts simulated lines and a gateway over them."""

    def launcher(
        simulate: Sequence[str] | None = (),
        devices: Sequence[tuple[str, str, int, int]] = DEMO_DEVICES,
        line_keys: str = "",
        rest: str = "",
        modbus_keys: str = "",
        *,
        http_keys: str = "",
        trusted: ssl.SSLContext | None = None,
        models: Mapping[str, str] = MODELS,
        upstreams: Mapping[str, int] | None = None,
        command: Sequence[str] = GATEWAY,
    ) -> Running:
        simulator = None
        if simulate is not None:
            simulator = start(*GATEWAY, "simulate", "--link-dir", str(tmp_path), *simulate)
            wait_until(lambda: any(path.is_symlink() for path in tmp_path.iterdir()), "the simulated lines")
        ports = (free_tcp_port(), free_udp_port(), free_tcp_port())
        write_config(
            tmp_path / "site.toml",
            ports,
            devices,
            line_keys,
            rest,
            modbus_keys=modbus_keys,
            http_keys=http_keys,
            models=models,
            upstreams=upstreams,
        )
        gateway = start(*command, "run", "-c", str(tmp_path / "site.toml"))
        return Running(tmp_path, *ports, gateway, simulator, trusted)

    return launcher
