"""Where the line's time goes: by purpose, device and client.

Rule 1: each second in which the line is occupied is booked once by purpose, once by device, and for client work on
        the clients that waited for it, in equal parts. Transactions that are under way at one time share it equally.
Rule 2: `sent` = `ok` + the sum of `failed` + those under way, at any moment.
Rule 3: at most `MAX_CLIENTS` clients are named; the rest is booked under `OTHERS`.
"""

from __future__ import annotations

from gateway.core.requests import PollItem, ReadTurn, Turn
from gateway.core.stats import LineStats
from gateway.core.turns import clients_of
from gateway.core.usage import UseMeter

MAX_CLIENTS = 256
OTHERS = "others"


class Accounting:
    """Books the transactions of one line into its `LineStats`."""

    def __init__(self, stats: LineStats, now: float) -> None:
        self._stats = stats
        self._use = UseMeter(now)
        self._at = now  # until when time is booked
        self._share_s = 0.0  # what a transaction that was under way all the time would have been given
        self._since: dict[int, float] = {}  # turn → the share when it went out

    def use_ratio(self, now: float) -> float:
        """Share of the last minute in which a transaction occupied the line, 0 to 1."""
        return self._use.ratio(now)

    def sent(self, turn: Turn, now: float) -> None:
        """A request goes out."""
        stats = self._stats
        self._advance(now)
        self._since[id(turn)] = self._share_s
        stats.sent += 1
        if isinstance(turn, PollItem):
            stats.polls += 1
            turn.device.stats.polls += 1
        elif isinstance(turn, ReadTurn):
            stats.client_reads += 1
            stats.joined += len(turn.reads) - 1
            for read in turn.reads:
                stats.retries += read.attempts > 1
                if read.attempts == 1 and not turn.again:
                    stats.queue_wait.observe(now - read.queued_at)
        else:
            stats.writes += 1
            stats.queue_wait.observe(now - turn.queued_at)

    def ended(self, turn: Turn, sent_at: float, now: float, failed: str | None) -> float:
        """The transaction is over; `failed` is its error label, None when the device gave data. Gives its line time."""
        stats = self._stats
        self._advance(now)
        seconds = self._share_s - self._since.pop(id(turn))
        if not self._since:
            self._share_s = 0.0  # so that nothing is lost to rounding where one follows the other
        stats.seconds_by_purpose[turn.purpose.value] += seconds
        turn.device.stats.line_s += seconds
        if failed is None:
            stats.ok += 1
            stats.reply_time.observe(now - sent_at)
        else:
            stats.failed[failed] += 1
            turn.device.stats.errors[failed] += 1
        clients = clients_of(turn)
        for client in clients:
            self._book(client, seconds / len(clients))
        return seconds

    def _advance(self, now: float) -> None:
        if self._since and now > self._at:
            self._stats.busy_s += now - self._at
            self._use.add(self._at, now)
            self._share_s += (now - self._at) / len(self._since)
        self._at = now

    def _book(self, client: str, seconds: float) -> None:
        clients = self._stats.seconds_by_client
        if client not in clients and len(clients) >= MAX_CLIENTS:
            client = OTHERS
        clients[client] = clients.get(client, 0.0) + seconds
