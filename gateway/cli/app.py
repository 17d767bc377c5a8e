"""All commands under one name; each lives in its own module."""

from __future__ import annotations

from importlib.metadata import version
from typing import Annotated

import typer

from gateway.cli import backup, check_config, clients, demo, generate, health, log, record, run, scan, simulate, writes

app = typer.Typer(
    help="Modbus TCP, SNMP and Prometheus for Morningstar solar charge controllers on serial lines.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,  # an operator's log wants the plain traceback
)
app.command("run")(run.command)
app.command("check-config")(check_config.command)
app.command("demo")(demo.command)
app.command("simulate")(simulate.command)
app.command("scan")(scan.command)
app.command("clients")(clients.command)
app.command("health")(health.command)
app.command("writes")(writes.command)
app.command("generate")(generate.command)
app.command("log")(log.command)
app.command("record")(record.record_command)
app.command("trace")(record.trace_command)
app.command("replay")(record.replay_command)
app.command("backup")(backup.backup_command)
app.command("restore")(backup.restore_command)


def _show_version(wanted: bool) -> None:
    if wanted:
        print(f"prostar-gateway {version('prostar-gateway')}")
        raise typer.Exit


@app.callback()
def _options(
    _version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version and exit.")
    ] = False,
) -> None:
    pass
