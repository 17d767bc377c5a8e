"""A simulated Modbus TCP server on a real port: what it does and when is `upstream.py`'s business."""

from __future__ import annotations

import asyncio
import socket
import struct
from types import TracebackType
from typing import Any, Generic, Protocol, Self, TypeVar, cast

from gateway.clock import Clock, SystemClock

_RESET = struct.pack("ii", 1, 0)  # SO_LINGER: on, for no time: closing is a reset


class Connection(Protocol):
    """A connection as its server sees it (upstream.ServerConnection says what is what)."""

    ended: str

    def receive(self, data: bytes, now: float) -> None:
        """Bytes that the client wrote."""
        ...

    def next_event(self) -> float | None:
        """When there is something for the client."""
        ...

    def take(self, now: float) -> bytes:
        """The bytes for the client by now."""
        ...

    def client_closed(self) -> None:
        """The client ended it."""
        ...


class Server(Protocol):
    """What is behind the port; `refusing` lets no connection in."""

    refusing: bool

    def connect(self) -> Connection:
        """A client connected."""
        ...


S = TypeVar("S", bound=Server)


class TcpServer(Generic[S]):
    """A server, mostly a `SimulatedServer`, that listens; use it as an async context manager, or `open` and `close` it.

    Port 0 takes a free one; `port` is the real one while it listens, and stays the same when it is opened again.
    """

    def __init__(self, server: S, *, host: str = "127.0.0.1", port: int = 0, clock: Clock | None = None) -> None:
        self.server = server
        self.host = host
        self.port = port
        self._clock = clock or SystemClock()
        self._listener: asyncio.Server | None = None
        self._peers: set[_Peer] = set()

    @property
    def url(self) -> str:
        """What a line's `port` says."""
        return f"tcp://[{self.host}]:{self.port}" if ":" in self.host else f"tcp://{self.host}:{self.port}"

    async def open(self) -> None:
        """Listen; OSError when the port cannot be had."""
        loop = asyncio.get_running_loop()
        self._listener = await loop.create_server(lambda: _Peer(self, self._clock), self.host, self.port)
        self.port = self._listener.sockets[0].getsockname()[1]

    def close(self) -> None:
        """Listen no more, and end all connections."""
        if self._listener is not None:
            self._listener.close()
            self._listener = None
        self.cut()

    def cut(self) -> None:
        """Reset all connections."""
        for peer in tuple(self._peers):
            peer.reset()

    async def __aenter__(self) -> Self:
        await self.open()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def came(self, peer: _Peer) -> None:
        """A client connected."""
        self._peers.add(peer)

    def gone(self, peer: _Peer) -> None:
        """A connection is over."""
        self._peers.discard(peer)


class _Peer(asyncio.Protocol):
    """One client's connection."""

    def __init__(self, owner: TcpServer[Any], clock: Clock) -> None:
        self._owner = owner
        self._clock = clock
        self._connection: Connection | None = None
        self._transport: asyncio.Transport | None = None
        self._timer: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast("asyncio.Transport", transport)  # uvloop's is none by its class
        if self._owner.server.refusing:
            self.reset()
            return
        self._connection = self._owner.server.connect()
        self._owner.came(self)
        self._serve()

    def data_received(self, data: bytes) -> None:
        if self._connection is not None:
            self._connection.receive(data, self._clock.monotonic())
            self._serve()

    def connection_lost(self, exc: Exception | None) -> None:
        del exc
        if self._timer is not None:
            self._timer.cancel()
        if self._connection is not None:
            self._connection.client_closed()
        self._transport = None
        self._owner.gone(self)

    def reset(self) -> None:
        """End it without a word."""
        if self._transport is not None:
            sock = self._transport.get_extra_info("socket")
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _RESET)
            self._transport.abort()

    def _serve(self) -> None:
        connection, transport = self._connection, self._transport
        if connection is None or transport is None:
            return
        now = self._clock.monotonic()
        data = connection.take(now)
        if data:
            transport.write(data)
        if connection.ended == "reset":
            self.reset()
            return
        if connection.ended:
            transport.close()
            return
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        due = connection.next_event()
        if due is not None:
            self._timer = asyncio.get_running_loop().call_later(max(0.0, due - now), self._serve)
