"""`prostar-gateway backup` and `restore`: what is in state_dir, into one file and out of it."""

from __future__ import annotations

import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, NoReturn

import typer

from gateway.cli.config_file import ConfigOption, load_or_exit, part_or_exit
from gateway.clock import SystemClock
from gateway.errors import BackupError
from gateway.service.backup import back_up, restore

Archive = Annotated[Path, typer.Argument(metavar="ARCHIVE", help="The tar archive.")]


def backup_command(archive: Archive, config: ConfigOption) -> None:
    """Write the configuration's state_dir to an archive, also while the gateway runs."""
    checked = part_or_exit(config, "site", "state_dir")
    try:
        names = back_up(Path(checked.state_dir), checked.site, archive, SystemClock().wall())
    except BackupError as error:
        _end(error)
    print(f"{archive}: {', '.join(names) or 'nothing'} of {checked.state_dir}")


def restore_command(archive: Archive, config: ConfigOption) -> None:
    """Put an archive into the configuration's state_dir; the gateway must not run."""
    checked = load_or_exit(config)
    try:
        manifest, moved = restore(archive, Path(checked.state_dir), SystemClock().wall())
    except BackupError as error:
        _end(error)
    made = datetime.fromtimestamp(manifest.made_at, UTC).isoformat(timespec="seconds")
    print(f"{checked.state_dir}: as {manifest.site} was at {made}")
    if manifest.site != checked.site:
        print(f"note: the configuration is of {checked.site}")
    if moved is not None:
        print(f"what was there is in {moved}")


def _end(error: BackupError) -> NoReturn:
    print(error, file=sys.stderr)
    raise typer.Exit(1) from None
