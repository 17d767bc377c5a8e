"""The command `prostar-gateway`: takes over the signals, then loads the commands.

Loading them takes most of a second, and a signal in that time must end the program as quietly as later. So this
file imports nothing but the standard library before the handlers stand.
"""

from __future__ import annotations

import os
import signal
import sys
from io import TextIOWrapper
from types import FrameType

UNTIL_STOPPED = ("run", "demo", "simulate", "replay")
"""Commands that run until a signal ends them; for the others a signal is an interruption."""


def main() -> None:
    """Run the command line."""
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, _leave)
    _mend_streams()
    if sys.argv[1:2] == ["run"]:
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGHUP})  # it waits until service/process.py can reload
        from gateway.cli.running import plain_arguments, run  # noqa: PLC0415 - only now are signals handled

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


def _mend_streams() -> None:
    """Have 0, 1 and 2 lead somewhere, and no letter end a command that standard output has no code for.

    Were one of them closed, the next socket or file would have its number, and what is printed would go there.
    """
    while (fd := os.open(os.devnull, os.O_RDWR)) <= 2:
        os.set_inheritable(fd, True)
    os.close(fd)
    if sys.stderr is None:
        sys.stderr = open(2, "w", closefd=False, encoding="utf-8", errors="backslashreplace")  # noqa: SIM115 - for good
    if isinstance(sys.stdout, TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")


def _leave(number: int, _frame: FrameType | None) -> None:
    raise SystemExit(0 if sys.argv[1:] and sys.argv[1] in UNTIL_STOPPED else 128 + number)
