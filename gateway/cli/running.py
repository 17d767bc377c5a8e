"""What `run` does, and its plain command lines.

Rule 1: nothing of the command line is loaded for a gateway that works for years: `plain_arguments` knows the options of
        run.py as a service unit writes them. Everything else, such as `--help` and what is wrong, is Typer's.
Rule 2: the configuration is read by another process while this one loads what the gateway is made of.
"""

from __future__ import annotations

import os
import resource
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from gateway.cli.refusing import refused
from gateway.errors import ConfigError, ReadingFailed
from gateway.service.logs import Level
from gateway.service.loops import Loop, loop_factory
from gateway.service.reading import Reading

_OPTIONS = {"-c": "config", "--config": "config", "--log-level": "log_level", "--loop": "loop"}


@dataclass(frozen=True, slots=True)
class Arguments:
    """What `run` is told."""

    config: Path
    log_level: Level | None = None
    loop: Loop = Loop.AUTO


def plain_arguments(words: Sequence[str]) -> Arguments | None:
    """The arguments behind `run`; None when they are not plain (rule 1)."""
    found: dict[str, str] = {}
    rest = list(words)
    while rest:
        option, equals, value = rest.pop(0).partition("=")
        if option not in _OPTIONS or (equals and not option.startswith("--")):
            return None
        if not equals:
            if not rest:
                return None
            value = rest.pop(0)
        found[_OPTIONS[option]] = value
    level, loop = found.get("log_level"), found.get("loop", Loop.AUTO)
    if not found.get("config") or loop not in list(Loop) or (level is not None and level not in list(Level)):
        return None
    if loop == Loop.UVLOOP and find_spec("uvloop") is None:
        return None
    return Arguments(Path(found["config"]), None if level is None else Level(level), Loop(loop))


def run(arguments: Arguments) -> int:
    """Read the lines and serve the faces until a signal stops it: the exit status. ValueError: no such loop."""
    path = arguments.config
    make_loop = loop_factory(arguments.loop)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))  # a core dump would hold pass phrases and keys
    try:
        with Reading(path) as reading:
            from gateway.service.log_writer import LogWriter, journal_reads  # noqa: PLC0415 - rule 2
            from gateway.service.logs import Log  # noqa: PLC0415 - as above
            from gateway.service.process import serve  # noqa: PLC0415 - as above
            from gateway.service.snmp import unreadable  # noqa: PLC0415 - as above
            from gateway.service.state_dir import claimed  # noqa: PLC0415 - as above

            checked = reading.result()
    except ConfigError as error:
        return refused(path, error.problems)
    except ReadingFailed as error:
        print(error, file=sys.stderr)
        return 1
    if missing := [f"{path}: {text}" for text in unreadable(checked)]:
        return refused(path, missing)
    with claimed(Path(checked.state_dir)) as mine:
        if not mine:
            print(f"{path}: another gateway uses the state_dir {checked.state_dir}", file=sys.stderr)
            return 1
        log = Log(
            LogWriter(sys.stderr.fileno(), journal=journal_reads(sys.stderr.fileno(), os.environ)), arguments.log_level
        )
        log.use(checked.log.level, checked.log.form)
        return serve(path, checked, make_loop, log)
