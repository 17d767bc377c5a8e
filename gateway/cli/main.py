"""The command `prostar-gateway`: takes over the signals, then loads the commands.

Loading them takes most of a second, and a signal in that time must end the program as quietly as later. So this
file imports nothing but the standard library before the handlers stand.
"""

from __future__ import annotations

import signal
import sys
from types import FrameType

UNTIL_STOPPED = ("run", "demo", "simulate", "replay")
"""Commands that run until a signal ends them; for the others a signal is an interruption."""

PRINT_ON = (*UNTIL_STOPPED, "log", "trace")
"""Commands that have more to print than most want to read; for the others a reader that leaves cuts them off."""


def main() -> None:
    """Run the command line."""
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, _leave)
    from gateway.cli.streams import mend  # noqa: PLC0415 - only now are signals handled

    output = mend(0 if sys.argv[1:] and sys.argv[1] in PRINT_ON else 128 + signal.SIGPIPE)
    try:
        _command()
    finally:
        output.end()


def _command() -> None:
    if sys.argv[1:2] == ["run"]:
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGHUP})  # it waits until service/process.py can reload
        from gateway.cli.running import plain_arguments, run  # noqa: PLC0415 - as above

        arguments = plain_arguments(sys.argv[2:])
        if arguments is not None:
            raise SystemExit(run(arguments))
    if sys.argv[1:2] == ["health"]:
        from gateway.cli import alive  # noqa: PLC0415 - as above

        path = alive.plain_arguments(sys.argv[2:])
        if path is not None:
            raise SystemExit(alive.health(path))
    from gateway.cli.app import app  # noqa: PLC0415 - as above

    app(prog_name="prostar-gateway")


def _leave(number: int, _frame: FrameType | None) -> None:
    raise SystemExit(0 if sys.argv[1:] and sys.argv[1] in UNTIL_STOPPED else 128 + number)
