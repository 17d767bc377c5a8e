"""`prostar-gateway run`: the gateway itself, until a signal stops it."""

from __future__ import annotations

from typing import Annotated

import typer

from gateway.cli.config_file import ConfigOption
from gateway.cli.running import Arguments, run
from gateway.service.logs import Level
from gateway.service.loops import Loop


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
        status = run(Arguments(config, log_level, loop))
    except ValueError as error:
        raise typer.BadParameter(str(error), param_hint="--loop") from None
    if status:
        raise typer.Exit(status)
