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

RUN = range(16)
"""As many datagrams are a run; each takes three microseconds or so."""

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
        first = until = 0  # the places in the run where requests of this source began, and where its allowance ends
        at = 0
        try:
            for at in RUN:
                data, address = receive(limit)
                if address[0] != host:
                    if source is not None:
                        source.left -= at - first
                    host = address[0]
                    source = sources.get(host)
                    first = until = at
                    if source is not None:
                        grant = source.communities
                        until += int(min(source.left, len(RUN)))
                try:
                    granted, id_at, column_at, row_at, routes, envelopes, _ = known[data[usual]]
                    rows, point, encodings, name = routes[data[column_at]]
                    device, index = rows[data[row_at]]
                    snapshot = device.snapshot
                    value = encodings[snapshot.values[point]]
                    before, behind = envelopes[len(value)]
                except Exception:  # noqa: BLE001 - mostly KeyError; with a defect the long way meets it, too, and says so
                    return data, address
                if at >= until or granted is not grant or snapshot.state is not _ONLINE:
                    return data, address
                try:
                    send(_join((before, data[id_at], behind, name, index, value)), address)
                except OSError:
                    self._counters.send_failures += 1
            at = len(RUN)
        finally:
            if source is not None:
                source.left -= at - first
            self._counters.in_packets += at
            self._counters.responses += at
        return None
