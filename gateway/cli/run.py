"""`prostar-gateway run`: the gateway itself, until a signal stops it."""

from __future__ import annotations

import os
import resource
import sys
from pathlib import Path
from typing import Annotated

import typer

from gateway.cli.config_file import ConfigOption, load_or_exit, refuse
from gateway.service.log_writer import LogWriter, journal_reads
from gateway.service.logs import Level, Log
from gateway.service.loops import Loop, loop_factory
from gateway.service.process import serve
from gateway.service.snmp import unreadable
from gateway.service.state_dir import claimed


def command(
    config: ConfigOption,
    log_level: Annotated[
        Level | None, typer.Option(help="From which level on events are logged to standard error; else as [log] says.")
    ] = None,
    loop: Annotated[Loop, typer.Option(help="The event loop; auto takes uvloop where it is installed.")] = Loop.AUTO,
) -> None:
    """Read the lines and serve the three faces until SIGTERM or Ctrl-C.

    Exit status 0 then, 78 for a bad configuration, 70 when a part of the gateway fails again and again.
    """
    try:
        make_loop = loop_factory(loop)
    except ValueError as error:
        raise typer.BadParameter(str(error), param_hint="--loop") from None
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))  # a core dump would hold pass phrases and keys
    checked = load_or_exit(config)
    if missing := [f"{config}: {text}" for text in unreadable(checked)]:
        refuse(config, missing)
    with claimed(Path(checked.state_dir)) as mine:
        if not mine:
            print(f"{config}: another gateway uses the state_dir {checked.state_dir}", file=sys.stderr)
            raise typer.Exit(1)
        log = Log(LogWriter(sys.stderr.fileno(), journal=journal_reads(sys.stderr.fileno(), os.environ)), log_level)
        log.use(checked.log.level, checked.log.form)
        if status := serve(config, checked, make_loop, log):
            raise typer.Exit(status)
