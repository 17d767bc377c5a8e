"""`prostar-gateway record`, `trace` and `replay`: what goes over a line, and a line that does the same again.

The running gateway gives the frames, at a socket in its `state_dir` (service/tracing.py), for as long as we listen.
"""

from __future__ import annotations

import asyncio
import json
import select
import signal
import socket
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer

from gateway.cli.config_file import ConfigOption, part_or_exit
from gateway.cli.printable import printable
from gateway.cli.stopping import Stop, stop_event
from gateway.modbus.recording import Piece, Recording
from gateway.service.tracing import FILE_NAME
from gateway.simulator.pty import PtyLine
from gateway.simulator.replay import ReplayedLine
from gateway.simulator.replay_tcp import ReplayedServer
from gateway.simulator.tcp import TcpServer

CONNECT_S = 5.0
_SIGNALS = (signal.SIGINT, signal.SIGTERM)
Line = Annotated[str, typer.Argument(metavar="LINE", help="The name of a line.")]


class _Failed(Exception):
    """The message says what is wrong."""


def record_command(
    config: ConfigOption,
    line: Line,
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Where to write the recording.")],
    seconds: Annotated[float, typer.Option(min=0.1, max=86400, help="How long.")] = 60.0,
    most_kib: Annotated[int, typer.Option(min=1, max=1 << 20, help="How large the file may become, in KiB.")] = 16384,
) -> None:
    """Record what goes over a line of the running gateway, for `replay`; Ctrl-C ends it earlier."""
    written = pieces = 0
    try:
        with file.open("x", encoding="ascii") as out:
            for text in _watch(config, line, seconds):
                if written + len(text) + 1 > most_kib * 1024:
                    print(f"the file has {most_kib} KiB: it ends here", file=sys.stderr)
                    break
                out.write(f"{text}\n")
                written += len(text) + 1
                pieces += 1
    except FileExistsError:
        _exit(f"{file} is there already")
    except OSError as error:
        _exit(f"{file} cannot be written: {error.strerror or error}")
    except _Failed as error:
        file.unlink(missing_ok=True)
        _exit(str(error))
    print(f"{max(0, pieces - 1)} pieces of {line} in {file}", file=sys.stderr)


def trace_command(
    config: ConfigOption,
    line: Line,
    seconds: Annotated[float, typer.Option(min=0.1, max=86400, help="How long.")] = 86400.0,
) -> None:
    """Print what goes over a line of the running gateway, until Ctrl-C: seconds, > sent or < received, bytes.

    Of an upstream's further connections the number is shown behind the arrow; no bytes: it was closed.
    """
    try:
        watched = _watch(config, line, seconds)
        about = json.loads(next(watched))
        how = "Modbus TCP" if _is_tcp(about) else f"{about['baudrate']} baud"
        print(f"{about['line']} at {about['port']}, {how}, since {about['began']}", flush=True)
        for text in watched:
            piece = Piece.parse(text)
            way = f"{'>' if piece.sent else '<'}{piece.connection or ''}"
            print(f"{piece.at_s:11.6f} {way} {piece.data.hex(' ') or 'closed'}", flush=True)
    except _Failed as error:
        _exit(str(error))


def replay_command(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="A recording that `record` made.")],
    link: Annotated[Path | None, typer.Option(metavar="PATH", help="Make a symlink to the pty there.")] = None,
    port: Annotated[
        int, typer.Option(min=0, max=65535, help="For an upstream: the TCP port on 127.0.0.1; 0 takes a free one.")
    ] = 0,
) -> None:
    """Be the far end of a recorded line, on a pty or as a Modbus TCP server, until a signal stops it."""
    try:
        with file.open(encoding="ascii") as lines:
            recording = Recording.parse(lines)
    except OSError as error:
        _exit(f"{file} cannot be read: {error.strerror or error}")
    except ValueError as error:
        _exit(f"{file}: {error}")
    if _is_tcp(recording.about):
        _replay_tcp(recording, link, port)
        return
    if port:
        _exit("--port is for the recording of an upstream")
    replayed = ReplayedLine(recording)
    try:
        asyncio.run(_replay(PtyLine(replayed, link=link), recording, replayed.requests))
    except OSError as error:
        _exit(f"cannot make a pty: {error}")
    print(f"answered={replayed.answered} unknown={replayed.unknown}", file=sys.stderr)


def _replay_tcp(recording: Recording, link: Path | None, port: int) -> None:
    if link is not None:
        _exit("--link is for the recording of a serial line")
    replayed = ReplayedServer(recording)
    try:
        asyncio.run(_replay(TcpServer(replayed, port=port), recording, replayed.requests))
    except OSError as error:
        _exit(f"cannot listen: {error.strerror or error}")
    print(f"answered={replayed.answered} unknown={replayed.unknown}", file=sys.stderr)


def _is_tcp(about: Mapping[str, Any]) -> bool:
    return about.get("protocol") == "modbus-tcp"


async def _replay(port: PtyLine | TcpServer[ReplayedServer], recording: Recording, requests: int) -> None:
    stopped = stop_event(_SIGNALS)
    async with port:
        where = port.path if isinstance(port, PtyLine) else port.url
        line = printable(str(recording.about.get("line", "?")))  # a file may be anybody's
        print(f"{line} with {requests} different requests at {where}", flush=True)
        await stopped.wait()


def _watch(config: Path, line: str, seconds: float) -> Iterator[str]:
    """The lines of a recording that is being made, the first of them what it is of; _Failed with the reason."""
    stop = Stop(_SIGNALS)
    path = Path(part_or_exit(config, "state_dir").state_dir) / FILE_NAME
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as sock:
        sock.settimeout(CONNECT_S)
        try:
            sock.connect(str(path))
            with suppress(BrokenPipeError):  # refused before it was asked: the reason is there to be read
                sock.sendall(json.dumps(line).encode() + b"\n")
        except OSError as error:
            raise _Failed(f"the gateway cannot be asked at {path}: {error.strerror or error}") from None
        until = time.monotonic() + seconds
        answered = False
        rest = b""
        while not stop.is_set and (left_s := until - time.monotonic()) > 0:
            if not select.select([sock], [], [], min(left_s, 0.2))[0]:
                continue
            data = b""
            with suppress(ConnectionError):  # the gateway was killed
                data = sock.recv(65536)
            if not data:
                break
            *whole, rest = (rest + data).split(b"\n")
            for text in whole:
                answered = True
                yield _checked(text.decode())
        if not answered:
            raise _Failed(f"the gateway at {path} gives no answer")


def _checked(text: str) -> str:
    found: Any = json.loads(text)
    if isinstance(found, dict) and "error" in found:
        raise _Failed(str(found["error"]))
    return text


def _exit(message: str) -> NoReturn:
    print(message, file=sys.stderr)
    raise typer.Exit(1)
