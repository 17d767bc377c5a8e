"""The engine of a Modbus TCP upstream: a line whose connection comes and goes while the line stays open.

Rule 1: the line is open from its first connection until none could be had again (`closed`, by the shell). Connections
        that follow each other without such a gap lead to the same server, so nothing is read or proved anew.
Rule 2: the shell ends the connections that `drops` names at once, and calls `lost` for each.
Rule 3: there may be several connections side by side, up to as many as are configured. The order of what is asked of
        one device does not hang on them: a write is alone with its device, whatever connection it goes out on
        (under_way.py).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from random import Random

from gateway.core.engine import LineEngine
from gateway.core.settings import LineSettings
from gateway.core.site import Device
from gateway.core.stats import LineStats
from gateway.modbus.counters import UpstreamCounters
from gateway.modbus.tcp import TcpClient

_TIDS = 0x10000


class UpstreamEngine(LineEngine):
    """Polls, client reads and writes of one upstream; `settings.upstream` says how it is used."""

    def __init__(self, settings: LineSettings, devices: Sequence[Device], now: float, rng: Random) -> None:
        assert settings.upstream is not None, "a serial line has a LineEngine"
        self.upstream = UpstreamCounters()
        stats = LineStats(upstream=self.upstream)
        self._tcp = TcpClient(
            stats.wire,
            self.upstream,
            most=settings.upstream.pipelining,
            first_tid=partial(rng.randrange, _TIDS),
            connections=settings.upstream.connections,
        )
        super().__init__(settings, devices, now, rng, wire=self._tcp, stats=stats)

    @property
    def silent(self) -> bool:
        """Whether the server answers nobody: the shell closes the line and tries later."""
        return self._tcp.silent

    @property
    def sent_on(self) -> int:
        """For which connection the frame is that `step` gave last."""
        return self._tcp.sent_on

    def drops(self) -> list[tuple[int, str]]:
        """The connections that must be ended now (rule 2), and why; "" where nothing is wrong with it."""
        return self._tcp.drops()

    def single_use(self, now: float) -> bool:
        """Whether the server closes after every reply."""
        return self._tcp.single_use(now)

    def lacks_connection(self, now: float) -> bool:
        """Whether something waits for nothing but one more connection (rule 3)."""
        return self._tcp.lacks(now) and self.due(now)

    def opened(self, now: float) -> None:
        """There is a connection, number 0, after a time without."""
        super().opened(now)
        self._tcp.connected(now)

    def connected(self, now: float, channel: int = 0) -> None:
        """There is another connection, with this number, while the line is open (rule 1)."""
        self._tcp.connected(now, channel)

    def receive(self, data: bytes, now: float, channel: int = 0) -> None:
        """Bytes came on that connection."""
        if self.is_open:
            self._ended(self._tcp.receive(data, now, channel), now)

    def lost(self, now: float, *, remote: bool, channel: int = 0) -> None:
        """A connection is over; `remote`: the other end closed or reset it."""
        self._ended(self._tcp.lost(now, remote=remote, channel=channel), now)
