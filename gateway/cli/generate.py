"""`prostar-gateway generate`: the files derived from the device maps."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from gateway.errors import MapError
from gateway.generate import outputs


def command(
    check: Annotated[
        bool, typer.Option("--check", help="Write nothing; exit 1 and name the files that differ.")
    ] = False,
    root: Annotated[
        Path, typer.Option(exists=True, file_okay=False, help="The source tree with its docs and mibs.")
    ] = Path(),
) -> None:
    """Make the MIB, the metric list and the register pages from the device maps."""
    try:
        paths = outputs.check(root) if check else outputs.write(root)
    except MapError as error:
        typer.echo(str(error), err=True)
        raise typer.Exit(1) from None
    verb = "differs" if check else "written"
    for path in paths:
        print(f"{verb} {path}")
    if check and paths:
        typer.echo("Derived files are not what the maps say: run `prostar-gateway generate` and commit.", err=True)
        raise typer.Exit(1)
