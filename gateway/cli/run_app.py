"""`run` alone: a service that works for years need not hold, nor load at its start, what the other commands take."""

from __future__ import annotations

import typer

from gateway.cli import run

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
app.command("run")(run.command)


@app.callback()
def _commands() -> None:
    """Keep `run` a command of its own: without this Typer takes a single command for the program."""
