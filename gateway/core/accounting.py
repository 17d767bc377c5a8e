"""Where the line's time goes: by purpose, device and client.

Rule 1: each second that a transaction occupies the line is booked once by purpose, once by device, and for client
        work on the clients that waited for it, in equal parts.
Rule 2: `sent` = `ok` + the sum of `failed` + the one on the wire, at any moment.
Rule 3: at most `MAX_CLIENTS` clients are named; the rest is booked under `OTHERS`.
"""

from __future__ import annotations

from gateway.core.requests import PollItem, ReadTurn, Turn, WriteTurn
from gateway.core.stats import LineStats
from gateway.core.usage import UseMeter

MAX_CLIENTS = 256
OTHERS = "others"


class Accounting:
    """Books the transactions of one line into its `LineStats`."""

    def __init__(self, stats: LineStats, now: float) -> None:
        self._stats = stats
        self._use = UseMeter(now)

    def use_ratio(self, now: float) -> float:
        """Share of the last minute in which a transaction occupied the line, 0 to 1."""
        return self._use.ratio(now)

    def sent(self, turn: Turn, now: float) -> None:
        """A request goes out."""
        stats = self._stats
        stats.sent += 1
        if isinstance(turn, PollItem):
            stats.polls += 1
            turn.device.stats.polls += 1
        elif isinstance(turn, ReadTurn):
            stats.client_reads += 1
            stats.joined += len(turn.reads) - 1
            for read in turn.reads:
                stats.retries += read.attempts > 1
                if read.attempts == 1:
                    stats.queue_wait.observe(now - read.queued_at)
        else:
            stats.writes += 1
            stats.queue_wait.observe(now - turn.queued_at)

    def ended(self, turn: Turn, sent_at: float, now: float, failed: str | None) -> None:
        """The transaction is over; `failed` is its error label, None when the device gave data."""
        stats = self._stats
        seconds = now - sent_at
        stats.busy_s += seconds
        self._use.add(sent_at, now)
        stats.seconds_by_purpose[turn.purpose.value] += seconds
        turn.device.stats.line_s += seconds
        if failed is None:
            stats.ok += 1
            stats.reply_time.observe(seconds)
        else:
            stats.failed[failed] += 1
            turn.device.stats.errors[failed] += 1
        for client in _clients(turn):
            self._book(client, seconds / max(1, len(_clients(turn))))

    def _book(self, client: str, seconds: float) -> None:
        clients = self._stats.seconds_by_client
        if client not in clients and len(clients) >= MAX_CLIENTS:
            client = OTHERS
        clients[client] = clients.get(client, 0.0) + seconds


def _clients(turn: Turn) -> list[str]:
    if isinstance(turn, ReadTurn):
        return list(dict.fromkeys(waiter.client for read in turn.reads for waiter in read.waiters))
    return [turn.waiter.client] if isinstance(turn, WriteTurn) else []
