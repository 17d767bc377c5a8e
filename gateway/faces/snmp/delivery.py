"""What goes to one receiver, and when again: no socket and no clock.

Rule 1: what waits is in the announcer, one entry a condition, and in `_standard`, one entry a notification of
        SNMPv2-MIB; under way are at most WINDOW informs. Nothing else is kept, however long a receiver is away.
Rule 2: new notifications cost a token each: `per_minute` in the long run, a minute's worth at once.
Rule 3: an inform is sent again until it is acknowledged, after FIRST_S and then twice as long each time, up to LAST_S.
        Until a receiver has acknowledged something, and when it left SILENT_AFTER attempts unanswered, only the oldest
        inform is sent to it; the first acknowledgement sets the others going.
Rule 4: a trap is sent once. When the system does not take it, it waits, as long as an inform would, and is told anew.
Rule 5: each notification has a number of its own, from 1: what a receiver misses, it can see.
"""

from __future__ import annotations

import math
import secrets
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import islice

from gateway.core.announcing import Announcement, Announcer
from gateway.core.conditions import Conditions, Watch
from gateway.core.ratelimit import Bucket
from gateway.core.stats import NotifyStats
from gateway.faces.snmp import notifications
from gateway.faces.snmp.notify_pdu import PduWriter
from gateway.faces.snmp.settings import Oid, Receiver

WINDOW = 8
FIRST_S = 2.0
LAST_S = 60.0
MOST_DOUBLED = 16
"""Doublings that are counted; LAST_S is met long before."""

SILENT_AFTER = 3
AT_ONCE = 2
"""Repetitions of one attempt that the receiver itself may ask for: to learn who it is, and what time it has."""

FAILURE_S = 60.0
"""At most one authenticationFailure in this time."""

_BURST_S = 60.0
_MASK = 0x7FFFFFFF


@dataclass(slots=True, eq=False)
class Note:
    """A notification on its way; the same request id in every attempt."""

    request_id: int
    pdu: bytes
    about: Announcement | Oid
    tries: int = 0
    at_once: int = 0  # repetitions that the receiver asked for since the last try
    wanted: bool = False  # the receiver asks for one now
    due: float = -math.inf


class Delivery:
    """The notifications of one receiver. `waiting` is how many conditions there may be something to tell of."""

    def __init__(
        self, receiver: Receiver, writer: PduWriter, stats: NotifyStats, now: float, *, cold: bool = True
    ) -> None:
        """`cold`: the gateway has just been started, and the receiver is to know it."""
        self.stats = stats
        self._inform = receiver.inform
        self._writer = writer
        self._announcer = Announcer(hold_s=receiver.hold_s, least=receiver.least)
        self._limit(receiver, now)
        self._standard: dict[Oid, None] = {notifications.COLD_START: None} if cold else {}
        self._under_way: dict[int, Note] = {}
        self._sequence = 0
        self._request_id = secrets.randbits(31)
        self._heard = False  # it acknowledged something, and has not been silent since
        self._held_until = -math.inf  # nothing new before
        self._hold_s = FIRST_S
        self._failure_at = -math.inf

    @property
    def silent(self) -> bool:
        """Whether the receiver leaves informs unanswered."""
        return any(note.tries > SILENT_AFTER for note in self._under_way.values())

    def changed(self, watches: Iterable[Watch], now: float) -> None:
        """The state of these conditions changed."""
        self._announcer.changed(watches, now)

    def adjust(self, receiver: Receiver, now: float) -> None:
        """Go on by other settings; what the receiver was told, and what it is still to be told, stays."""
        self._announcer.adjust(hold_s=receiver.hold_s, least=receiver.least)
        self._limit(receiver, now)

    def _limit(self, receiver: Receiver, now: float) -> None:
        self._interval_s = 60.0 / receiver.per_minute
        self._bucket = Bucket(receiver.per_minute / 60.0, _BURST_S, now)

    def go_on(self, conditions: Conditions) -> None:
        """There are these conditions from now on; what is under way about others goes on until it is acknowledged."""
        self._announcer.go_on(conditions)

    def authentication_failed(self, now: float) -> None:
        """Somebody used a wrong credential."""
        if now - self._failure_at >= FAILURE_S:
            self._failure_at = now
            self._standard[notifications.AUTHENTICATION_FAILURE] = None

    def outgoing(self, now: float) -> list[Note]:
        """What is to be sent now; `sent` or `not_sent` follows for each."""
        out = [note for note in self._due() if note.due <= now]
        room = self._room()
        if room > 0 and now >= self._held_until:
            out += self._new(now, room)
        self.stats.waiting = len(self._announcer) + len(self._standard) + len(self._under_way)
        return out

    def sent(self, note: Note, now: float) -> None:
        """It is on the wire."""
        self.stats.sent += 1
        self.stats.repeated += note.tries > 0
        if self._inform:
            self._tried(note, now)
        else:
            self._hold_s = FIRST_S
            self._over(note)

    def not_sent(self, note: Note, now: float) -> None:
        """The system did not take it."""
        self.stats.failures += 1
        if self._inform:
            self._tried(note, now)
            return
        self._sequence -= 1  # it is the latest: traps go one by one
        self._held_until = now + self._hold_s
        self._hold_s = min(LAST_S, 2 * self._hold_s)
        if isinstance(note.about, Announcement):
            self._announcer.lost(note.about)
        else:
            self._standard[note.about] = None

    def acknowledged(self, request_id: int, now: float) -> None:
        """The receiver has it; an id that is not under way is ignored."""
        note = self._under_way.pop(request_id, None)
        if note is None:
            return
        self.stats.acknowledged += 1
        self.stats.acknowledged_at = now
        self._over(note)
        if not self._heard:
            self._heard = True
            for other in self._under_way.values():
                other.tries, other.due = 0, now

    def again(self, request_id: int, now: float) -> None:
        """The receiver wants it once more, and told what it lacks."""
        note = self._under_way.get(request_id)
        if note is not None and note.at_once < AT_ONCE:
            note.at_once += 1
            note.wanted = True
            note.due = now

    def next_deadline(self, now: float) -> float | None:
        """When there is something to send; None: not before something changes."""
        moments = [note.due for note in self._due()]
        if self._room() > 0:
            new = self._announcer.next_due()
            if self._standard:
                new = now
            if new is not None:
                moments.append(max(new, self._held_until))
        return min(moments, default=None)

    def _due(self) -> list[Note]:
        """The informs that may be repeated."""
        notes = list(self._under_way.values())
        return notes if self._heard else notes[:1]

    def _room(self) -> int:
        """How many new notifications may go out."""
        if not self._inform:
            return 1
        return (WINDOW if self._heard else 1) - len(self._under_way)

    def _tried(self, note: Note, now: float) -> None:
        """An attempt to send an inform was made."""
        if note.wanted:
            note.wanted = False
        else:
            note.tries += 1
            note.at_once = 0
        if note.tries > SILENT_AFTER:
            self._heard = False
        note.due = now + min(LAST_S, FIRST_S * 2.0 ** min(note.tries - 1, MOST_DOUBLED))

    def _new(self, now: float, room: int) -> list[Note]:
        tokens = self._bucket.take(now, room)
        if not tokens:
            self._held_until = now + self._interval_s
            return []
        about: list[Announcement | Oid] = [*islice(self._standard, tokens)]
        self._standard = {oid: None for oid in self._standard if oid not in about}
        about += self._announcer.take(now, tokens - len(about))
        self._bucket.give_back(tokens - len(about))
        return [self._note(each, now) for each in about]

    def _note(self, about: Announcement | Oid, now: float) -> Note:
        self._sequence += 1
        self._request_id = (self._request_id + 1) & _MASK
        if isinstance(about, Announcement):
            pdu = self._writer.condition(about, self._sequence, self._request_id, now)
        else:
            pdu = self._writer.standard(about, self._sequence, self._request_id, now)
        note = Note(self._request_id, pdu, about)
        self.stats.notifications += 1
        if self._inform:
            self._under_way[note.request_id] = note
        return note

    def _over(self, note: Note) -> None:
        if isinstance(note.about, Announcement):
            self._announcer.confirmed(note.about.watch)
