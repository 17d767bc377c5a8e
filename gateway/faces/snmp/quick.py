"""Runs of known requests for a number each, from socket to socket.

A poller's GET costs two system calls, and in Python a call of a function costs as much as two look-ups. So the
look-ups of `singles.py` stand here once more, in a loop that calls nothing else. Rules:

1. What is answered here is what `Singles.reply` would answer, to whom it would; the source, its allowance and the
   counters are those of the long way. tests/faces/snmp/test_singles.py holds both against an agent that forgets.
2. The first datagram that is not answered by look-ups ends the run and is given back, unanswered and not yet counted.
3. A run is short, so that its caller can look at the clock.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from gateway.core.snapshot import DeviceState
from gateway.faces.snmp.access import Source
from gateway.faces.snmp.counters import SnmpCounters
from gateway.faces.snmp.singles import Singles

RUN = range(8)
"""As many datagrams are a run; each takes some microseconds."""

Datagram = tuple[bytes, Any]
"""What came, and where from: an address as the socket gives it, the host first."""

_ONLINE = DeviceState.ONLINE
_join = b"".join


class Quick:
    """Answers runs of requests that come to the default context."""

    def __init__(
        self, sources: Mapping[str, Source | None], singles: Singles, counters: SnmpCounters, limit: int
    ) -> None:
        """`sources` are those that are known, `limit` the octets that are read of a datagram."""
        self._sources = sources
        self._singles = singles
        self._counters = counters
        self._limit = limit

    def answer(self, receive: Callable[[int], Datagram], send: Callable[[bytes, Any], object]) -> Datagram | None:
        """Answer known requests; the first that is none of these, if there is one in the run.

        Whatever `receive` raises ends the run as well.
        """
        sources, known, limit, usual = self._sources, self._singles.known, self._limit, self._singles.usual
        host = source = grant = None
        left = 0.0  # of the allowance of the source
        answered = 0
        try:
            for _ in RUN:
                data, address = receive(limit)
                if address[0] != host:
                    if source is not None:
                        source.left = left
                    host = address[0]
                    source = sources.get(host)
                    grant, left = (None, 0.0) if source is None else (source.communities, source.left)
                way = known.get(data[usual])
                if way is None or left < 1.0 or way[1] is not grant:
                    return data, address
                _, _, id_at, column_at, row_at, routes, envelopes = way
                try:
                    rows, point, encodings, name = routes[data[column_at]]
                    device, index = rows[data[row_at]]
                    snapshot = device.snapshot
                    if snapshot.state is not _ONLINE:
                        return data, address
                    value = encodings[snapshot.values[point]]
                    before, behind = envelopes[len(value)]
                except KeyError:
                    return data, address
                answered += 1
                left -= 1.0
                try:
                    send(_join((before, data[id_at], behind, name, index, value)), address)
                except OSError:
                    self._counters.send_failures += 1
        finally:
            if source is not None:
                source.left = left
            self._counters.in_packets += answered
            self._counters.responses += answered
        return None
