"""`prostar-gateway generate`: the files derived from the device maps."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from gateway.errors import MapError
from gateway.generate import outputs
from gateway.service.parsing import parse_root


def command(
    check: Annotated[
        bool, typer.Option("--check", help="Write nothing; exit 1 and name the files that differ.")
    ] = False,
    root: Annotated[
        Path, typer.Option(exists=True, file_okay=False, help="The source tree with its docs and mibs.")
    ] = Path(),
    enterprise_root: Annotated[
        str,
        typer.Option(
            help="Your snmp.enterprise_root: make only the MIB and the files for an NMS, with it, below --root.",
        ),
    ] = "",
) -> None:
    """Make the MIB, the metric list, the register pages and the files under deploy/ from the device maps."""
    try:
        made = outputs.own_outputs(parse_root(enterprise_root)) if enterprise_root else None
    except ValueError as error:
        raise typer.BadParameter(f"{enterprise_root!r}: {error}", param_hint="--enterprise-root") from None
    try:
        paths = outputs.check(root, made) if check else outputs.write(root, made)
    except MapError as error:
        typer.echo(str(error), err=True)
        raise typer.Exit(1) from None
    verb = "differs" if check else "written"
    for path in paths:
        print(f"{verb} {root / path if enterprise_root else path}")
    if check and paths:
        typer.echo("Derived files are not what the maps say: run `prostar-gateway generate` and commit.", err=True)
        raise typer.Exit(1)
