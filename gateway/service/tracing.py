"""The frames of a line, for who asks: a socket in `state_dir` that gives the recording of a line while it is written.

Rule 1: nothing is traced but while somebody is connected and for that line. There is no switch that can be forgotten.
Rule 2: who may connect is who may enter `state_dir`: the gateway's own user and root. The frames hold the values
        of registers; they are nowhere else, and never in the log.
Rule 3: one who reads slower than the line talks loses pieces, and is told how many by the end of the connection;
        nobody waits for it. There are at most `WATCHERS`.
Rule 4: a `state_dir` that takes no socket is said once; it is tried again every `AGAIN_S`.
Rule 5: a line that a reload takes away, or puts another one in the place of, says nothing more: the recording ends.

The question is one line, the name of the line as JSON text; the answer is a recording (modbus/recording.py), or a line
`{"error": …}`.
"""

from __future__ import annotations

import asyncio
import json
import logging
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from gateway.clock import Clock
from gateway.core.site import LinePort
from gateway.lines.shell import LineShell
from gateway.modbus.recording import Piece, header_line

FILE_NAME = "trace"
WATCHERS = 4
MOST_UNREAD = 1 << 20
QUESTION_S = 5.0
AGAIN_S = 60.0
LOOK_S = 1.0
"""How often it is looked whether the line is still there."""

_log = logging.getLogger(__name__)


class Tracer:
    """The keeper of the socket; `lines` are those of the gateway at any moment."""

    name = "trace"

    def __init__(self, state_dir: Path, lines: Callable[[], Sequence[LinePort]], clock: Clock) -> None:
        self._path = state_dir / FILE_NAME
        self._lines = lines
        self._clock = clock
        self._watchers: set[asyncio.Task[Any]] = set()

    async def run(self) -> None:
        """Answer until cancelled."""
        said = ""
        while True:
            try:
                server = await asyncio.start_unix_server(self._connected, self._path, limit=1024)
                self._path.chmod(0o600)
            except OSError as error:
                reason = error.strerror or str(error)
                if reason != said:
                    _log.warning('event=trace_off socket="%s" reason="%s"', self._path, reason.replace('"', "'"))
                    said = reason
                await asyncio.sleep(AGAIN_S)
                continue
            async with server:
                try:
                    await server.serve_forever()
                finally:
                    for task in self._watchers:
                        task.cancel()
                    with suppress(OSError):
                        self._path.unlink()

    async def _connected(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        try:
            if len(self._watchers) >= WATCHERS:
                self._refuse(writer, f"{WATCHERS} are watching already")
                return
            self._watchers.add(task)
            async with asyncio.timeout(QUESTION_S):
                question = await reader.readline()
            await self._answer(question, reader, writer)
        except (TimeoutError, ValueError, RecursionError, OSError):
            pass  # who asks nothing, too much, or is gone, gets nothing
        except asyncio.CancelledError:
            pass  # the gateway stops; what was written is flushed by who closes
        finally:
            self._watchers.discard(task)
            writer.close()

    async def _answer(self, question: bytes, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        name = json.loads(question)
        line = next((one for one in self._lines() if one.name == name), None)
        if not isinstance(line, LineShell):
            names = ", ".join(one.name for one in self._lines())
            self._refuse(writer, f"there is no line {json.dumps(name)}; there are: {names}")
            return
        began = self._clock.monotonic()
        lost = 0

        def watch(now: float, sent: bool, data: bytes, connection: int) -> None:  # noqa: FBT001 - as `Watcher` says
            nonlocal lost
            if writer.transport.get_write_buffer_size() > MOST_UNREAD:
                lost += 1
                return
            writer.write(f"{Piece(now - began, sent, data, connection).line()}\n".encode())

        writer.write(f"{header_line(_about(line, self._clock))}\n".encode())
        _log.info("event=trace line=%s state=on", line.name)
        line.tap.open(watch)
        closed = asyncio.create_task(reader.read())  # nobody has anything more to say
        try:
            while not closed.done() and line in self._lines():
                await asyncio.wait((closed,), timeout=LOOK_S)
            if closed.done():
                closed.result()
        finally:
            closed.cancel()
            line.tap.close(watch)
            lasted_s = self._clock.monotonic() - began
            _log.info("event=trace line=%s state=off lasted_s=%.1f lost=%d", line.name, lasted_s, lost)

    def _refuse(self, writer: asyncio.StreamWriter, reason: str) -> None:
        writer.write(f"{json.dumps({'error': reason})}\n".encode())


def _about(line: LineShell, clock: Clock) -> Mapping[str, Any]:
    settings = line.settings
    wire: dict[str, Any] = {"protocol": "modbus-tcp"}
    if settings.upstream is None:
        wire = {"baudrate": settings.baudrate, "parity": settings.parity, "stopbits": settings.stopbits}
    began = datetime.fromtimestamp(clock.wall(), UTC).isoformat(timespec="milliseconds")
    return {"line": line.name, "port": line.port, **wire, "began": began}
