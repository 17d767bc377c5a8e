"""Reading the configuration in a process of its own: `python -m gateway.service.reading FILE`.

Rule 1: what checks a configuration (pydantic and the classes of schema.py: 12 MiB, a fifth of a second) is of use for
        that second, and the gateway runs for years. So another process reads and checks, at each start and reload.
Rule 2: it runs the same code as this one, from the same places, whatever folder it is started in.
Rule 3: it says by JSON what is right, or everything that is wrong. Secrets that are files are not in it; what the file
        itself holds (communities) goes through a pipe and nowhere else.
Rule 4: a process that cannot be had, or does not say anything, is no verdict on the file: ReadingFailed.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Self, cast

from gateway.errors import ConfigError, ReadingFailed
from gateway.service.plain import PlainTable, from_json, to_json

if TYPE_CHECKING:
    from gateway.service.schema import Config

READ_S = 60.0
"""Longer than the slowest machine takes."""


class Reading:
    """A configuration that is being read."""

    def __init__(self, path: Path) -> None:
        """Begin; used by `with`. ReadingFailed when there is no process to be had."""
        self._path = path
        command = [sys.executable, "-P", "-m", "gateway.service.reading", str(path)]
        try:
            # Within the `try`: the folder that we are in may be gone.
            places = os.pathsep.join(str(Path(place).absolute()) for place in sys.path)
            self._process = subprocess.Popen(  # noqa: S603 - this program itself
                command,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                env={**os.environ, "PYTHONPATH": places, "PYDANTIC_DISABLE_PLUGINS": "__all__"},
                process_group=0,  # Ctrl-C is for who waits for it
            )
        except OSError as error:
            raise ReadingFailed(f"{path}: no process can be started to read it: {error.strerror or error}") from None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """Whoever does not wait for the result ends its process."""
        if self._process.poll() is None:
            self._process.kill()
        with self._process:
            pass

    def give_up(self) -> None:
        """End its process, so that whoever waits for the result, in another thread, need not go on; never waits."""
        self._process.kill()

    def result(self) -> Config:
        """Wait for the end: the configuration; ConfigError with everything that is wrong, or ReadingFailed."""
        try:
            written, _ = self._process.communicate(timeout=READ_S)
        except subprocess.TimeoutExpired:
            raise ReadingFailed(f"{self._path}: is not read after {READ_S:g} s") from None
        return _result(written, f"{self._path}: the process that reads it ended with status {self._process.returncode}")


def read_config(path: Path, begun: Callable[[Reading], None] = lambda _reading: None) -> Config:
    """The configuration in the file; ConfigError as `load_config`, ReadingFailed when it could not be read (rule 4).

    `begun` is told of the reading, so that another thread may give it up.
    """
    with Reading(path) as reading:
        begun(reading)
        return reading.result()


def _result(written: bytes, otherwise: str) -> Config:
    try:
        found = json.loads(written)
    except ValueError:
        raise ReadingFailed(otherwise) from None
    if not isinstance(found, Mapping):
        raise ReadingFailed(otherwise)
    if "problems" in found:
        raise ConfigError(tuple(map(str, found["problems"])))
    config = from_json(found.get("config"))
    if not isinstance(config, PlainTable):
        raise ReadingFailed(otherwise)
    return cast("Config", config)


def main() -> None:
    """Read the file that is named, and say what came of it."""
    from gateway.service.config import load_config  # noqa: PLC0415 - rule 1: who waits for the answer has it not

    try:
        found: dict[str, object] = {"config": to_json(load_config(Path(sys.argv[1])))}
    except ConfigError as error:
        found = {"problems": error.problems}
    with suppress(BrokenPipeError), open(1, "wb", closefd=False) as answer:  # who asked may be gone
        answer.write(json.dumps(found).encode())


if __name__ == "__main__":
    main()
