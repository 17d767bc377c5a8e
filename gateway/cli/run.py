"""`prostar-gateway run`: the gateway itself, until a signal stops it."""

from __future__ import annotations

import resource
import sys
from pathlib import Path
from typing import Annotated

import typer

from gateway.cli.config_file import ConfigOption, load_or_exit, refuse
from gateway.service.logs import Level, set_up_logging
from gateway.service.loops import Loop, loop_factory
from gateway.service.process import serve
from gateway.service.snmp import unreadable
from gateway.service.state_dir import claimed


def command(
    config: ConfigOption,
    log_level: Annotated[
        Level, typer.Option(help="From which level on events are logged to standard error.")
    ] = Level.INFO,
    loop: Annotated[Loop, typer.Option(help="The event loop; auto takes uvloop where it is installed.")] = Loop.AUTO,
) -> None:
    """Read the lines and serve the three faces until SIGTERM or Ctrl-C.

    Exit status 0 then, 78 for a bad configuration, 70 when a part of the gateway fails again and again.
    """
    try:
        make_loop = loop_factory(loop)
    except ValueError as error:
        raise typer.BadParameter(str(error), param_hint="--loop") from None
    set_up_logging(log_level)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))  # a core dump would hold pass phrases and keys
    checked = load_or_exit(config)
    if missing := [f"{config}: {text}" for text in unreadable(checked)]:
        refuse(config, missing)
    with claimed(Path(checked.state_dir)) as mine:
        if not mine:
            print(f"{config}: another gateway uses the state_dir {checked.state_dir}", file=sys.stderr)
            raise typer.Exit(1)
        if status := serve(config, checked, make_loop):
            raise typer.Exit(status)
