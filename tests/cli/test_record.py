"""`record` and `trace` where the gateway that they ask does not answer; how they work is in tests/faults/service."""

from __future__ import annotations

import signal
import socket
import subprocess
from collections.abc import Iterator
from pathlib import Path
from threading import Thread

import pytest
from typer.testing import CliRunner

from gateway.cli.app import app
from gateway.modbus.recording import header_line
from tests.e2e.programs import GATEWAY

CONFIG = """
site = "ridge-07"
state_dir = "{folder}"
[[line]]
name = "shelter-a"
port = "/dev/ttyS0"
[[line.device]]
name = "array-1"
address = 1
unit_id = 11
model = "prostar-mppt"
"""


@pytest.fixture(autouse=True)
def signals() -> Iterator[None]:
    """The commands take them over."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.parametrize("closes", [False, True], ids=["hangs", "ends"])
@pytest.mark.parametrize("command", ["record", "trace"])
def test_a_gateway_that_does_not_answer_is_named(tmp_path: Path, command: str, closes: bool) -> None:
    config, recording = tmp_path / "site.toml", tmp_path / "line.rec"
    config.write_text(CONFIG.format(folder=tmp_path))
    arguments = [command, "-c", str(config), "shelter-a", *([str(recording)] if command == "record" else [])]
    with socket.socket(socket.AF_UNIX) as gateway:
        gateway.bind(str(tmp_path / "trace"))
        gateway.listen()

        def end() -> None:
            if closes:
                gateway.accept()[0].close()

        answering = Thread(target=end)
        answering.start()
        done = CliRunner().invoke(app, [*arguments, "--seconds", "60" if closes else "0.1"])
        answering.join()
    assert (done.exit_code, done.stdout) == (1, "")
    assert done.stderr == f"the gateway at {tmp_path / 'trace'} gives no answer\n"
    assert not recording.exists()


def test_the_name_in_somebodys_recording_does_nothing_to_the_terminal(tmp_path: Path) -> None:
    recording = tmp_path / "line.rec"
    recording.write_text(header_line({"line": "a\x1b[31m\nb"}) + "\n")
    with subprocess.Popen([*GATEWAY, "replay", str(recording)], stdout=subprocess.PIPE, text=True) as replay:
        assert replay.stdout is not None
        assert replay.stdout.readline().startswith("a?[31m?b with 0 different requests at /dev/pts/")
        replay.terminate()
        assert replay.wait(30) == 0
