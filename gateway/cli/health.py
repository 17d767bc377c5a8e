"""`prostar-gateway health`; what it does is in alive.py, which main.py runs without all of this where it can."""

from __future__ import annotations

import typer

from gateway.cli.alive import health
from gateway.cli.config_file import ConfigOption


def command(config: ConfigOption) -> None:
    """Ask the running gateway whether it is alive: exit status 0 when its `/healthz` answers, otherwise 1."""
    status = health(config)
    if status:
        raise typer.Exit(status)
