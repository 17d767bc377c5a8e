"""The engine of a Modbus TCP upstream: a line whose connection comes and goes while the line stays open.

Rule 1: the line is open from its first connection until none could be had again (`closed`, by the shell). Connections
        that follow each other without such a gap lead to the same server, so nothing is read or proved anew.
Rule 2: when `drop` is not None, the shell ends the connection at once and calls `lost`.
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
            stats.wire, self.upstream, most=settings.upstream.pipelining, first_tid=partial(rng.randrange, _TIDS)
        )
        super().__init__(settings, devices, now, rng, wire=self._tcp, stats=stats)

    @property
    def drop(self) -> str | None:
        """Why the connection must be ended now (rule 2), "" when nothing is wrong with it; None: it may stay."""
        return self._tcp.drop

    @property
    def silent(self) -> bool:
        """Whether the server answers nobody: the shell closes the line and tries later."""
        return self._tcp.silent

    def opened(self, now: float) -> None:
        """There is a connection, after a time without."""
        super().opened(now)
        self._tcp.connected(now)

    def connected(self, now: float) -> None:
        """There is another connection while the line is open (rule 1)."""
        self._tcp.connected(now)

    def lost(self, now: float, *, remote: bool) -> None:
        """The connection is over; `remote`: the other end closed or reset it."""
        self._ended(self._tcp.lost(now, remote=remote), now)
