"""Standard input, output and error of every command, however whoever starts it has left them.

Rule 1: 0, 1 and 2 lead somewhere. Were one of them closed, the next socket or file would have its number, and what is
        printed would go there.
Rule 2: no letter ends a command that the terminal has no code for.
Rule 3: a command ends with the first thing that it cannot print: quietly where nobody reads any more (`log | head`, a
        terminal that was closed), else with exit status 1 and one line that says why (a full disk).
Rule 4: what cannot be said on standard error is left out; the exit status says it.
"""

from __future__ import annotations

import errno
import os
import stat
import sys
from io import BufferedWriter, FileIO, TextIOWrapper
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer


class Output(FileIO):
    """Standard output by rule 3: a write that fails is SystemExit, and so is every one after it until `end`."""

    def __init__(self, when_gone: int) -> None:
        """`when_gone`: the exit status where nobody reads any more."""
        super().__init__(1, "w", closefd=False)
        self._when_gone = when_gone
        self._failed = self._ended = False
        self._text = _text(self, sys.stdout)
        sys.stdout = self._text

    def write(self, data: ReadableBuffer, /) -> int:
        """Write some of it; how much."""
        try:
            return super().write(data)
        except OSError as error:
            if self._ended:
                return memoryview(data).nbytes
            if self._nobody_reads(error):
                raise SystemExit(self._when_gone) from None
            if not self._failed:
                print(f"standard output cannot be written: {error.strerror}", file=sys.stderr)
            self._failed = True
            raise SystemExit(1) from None

    def end(self) -> None:
        """Write what is left, when the command is over; nothing after it fails."""
        try:
            self._text.flush()
        finally:
            self._ended = True

    def _nobody_reads(self, error: OSError) -> bool:
        """A pipe without a reader, or a terminal that was closed; of a disk the latter's error is a broken one."""
        if error.errno == errno.EIO:
            return stat.S_ISCHR(os.fstat(self.fileno()).st_mode)
        return error.errno == errno.EPIPE


class _Errors(FileIO):
    """Standard error by rule 4."""

    def write(self, data: ReadableBuffer, /) -> int:
        try:
            return super().write(data)
        except OSError:
            return memoryview(data).nbytes


def mend(when_gone: int) -> Output:
    """Have the standard streams follow the rules of this file; its `end` must be called."""
    while (fd := os.open(os.devnull, os.O_RDWR)) <= 2:
        os.set_inheritable(fd, True)
    os.close(fd)
    sys.stderr = _text(_Errors(2, "w", closefd=False), sys.stderr, line_buffering=True)
    return Output(when_gone)


def _text(raw: FileIO, before: object, *, line_buffering: bool = False) -> TextIOWrapper:
    """The text layer of a stream, as the interpreter made that of before; None: it was closed."""
    encoding = "utf-8"
    if isinstance(before, TextIOWrapper):
        encoding, line_buffering = before.encoding, line_buffering or before.line_buffering or before.write_through
    return TextIOWrapper(BufferedWriter(raw), encoding, errors="backslashreplace", line_buffering=line_buffering)
