"""The write ledger: what its lines say, and what follows from them after a restart.

Rule 1: a line is one record, complete in itself: a JSON object and a line end. What is no such line (cut off by a power
        failure, from a later version) is skipped and counted; it never makes the rest unreadable.
Rule 2: an `Intent` stands in the ledger before the bytes go out, a `Verdict` after it. An intent without a verdict, or
        with the verdict "unknown", is open: nobody knows, until the register is read back.
Rule 3: the last verdict holds. One that is given later, by reading back, replaces "unknown".
Rule 4: the ledger also remembers wear. When a new file is begun, it begins with what is still needed of the old ones:
        the writes of the last day to what wears (`Worn`), and the open intents.

Times are Unix time, for people and for the days in between two runs.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime
from enum import StrEnum

from gateway.core.write_wear import DAY_S, Cell
from gateway.devices.model import Space

MAX_OPEN = 64
"""Open intents that are remembered; what is older stays unknown."""


class Fate(StrEnum):
    """How a single write ended."""

    WRITTEN = "written"  # confirmed by the device, and read back where its memory wears
    UNCHANGED = "unchanged"  # it held the value already; not written, not in the ledger
    DIFFERS = "differs"  # confirmed or perhaps taken, and something else is there
    REFUSED = "refused"  # the device's own exception
    NOT_SENT = "not_sent"
    NOT_WRITTEN = "not_written"  # no answer came, and the old value is still there
    UNKNOWN = "unknown"  # no answer came


@dataclass(frozen=True, slots=True)
class Intent:
    """A single write that is about to go out."""

    id: str
    at: float
    peer: str
    role: str | None
    unit_id: int
    device: str
    point: str
    space: Space
    address: int
    old: int | None  # what was there, as far as known
    new: int
    wears: bool
    left_out: int = 0  # rewrites of the same register since the last entry, which have none of their own

    @property
    def cell(self) -> Cell:
        """Which register or coil."""
        return (self.unit_id, self.space, self.address)


@dataclass(frozen=True, slots=True)
class Verdict:
    """How the write of that id ended."""

    id: str
    at: float
    fate: Fate
    exception: int | None = None  # the Modbus exception code that the client was told
    found: int | None = None  # what was read back


@dataclass(frozen=True, slots=True)
class Worn:
    """When a register that wears was written, as far as it matters."""

    unit_id: int
    space: Space
    address: int
    times: tuple[float, ...]


Record = Intent | Verdict | Worn


def encode(record: Record) -> bytes:
    """The record's line."""
    if isinstance(record, Intent):
        fields: dict[str, object] = {
            "intended": record.id,
            "at": _text(record.at),
            "peer": record.peer,
            "role": record.role,
            "unit_id": record.unit_id,
            "device": record.device,
            "point": record.point,
            "space": record.space,
            "address": _hex(record.address),
            "old": _hex(record.old),
            "new": _hex(record.new),
            "wears": record.wears,
            "left_out": record.left_out,
        }
    elif isinstance(record, Verdict):
        fields = {
            "outcome": record.id,
            "at": _text(record.at),
            "fate": record.fate,
            "exception": _hex(record.exception, 2),
            "found": _hex(record.found),
        }
    else:
        fields = {
            "worn": [record.unit_id, record.space, _hex(record.address)],
            "times": [_text(at) for at in record.times],
        }
    return json.dumps(fields, ensure_ascii=False, separators=(",", ":")).encode() + b"\n"


def decode(line: bytes) -> Record | None:
    """The record of a line, or None when it is none (rule 1)."""
    try:
        fields = json.loads(line)
        if "intended" in fields:
            return Intent(
                id=str(fields["intended"]),
                at=_time(fields["at"]),
                peer=str(fields["peer"]),
                role=None if fields["role"] is None else str(fields["role"]),
                unit_id=int(fields["unit_id"]),
                device=str(fields["device"]),
                point=str(fields["point"]),
                space=Space(fields["space"]),
                address=int(fields["address"], 16),
                old=_number(fields["old"]),
                new=int(fields["new"], 16),
                wears=bool(fields["wears"]),
                left_out=int(fields["left_out"]),
            )
        if "outcome" in fields:
            return Verdict(
                id=str(fields["outcome"]),
                at=_time(fields["at"]),
                fate=Fate(fields["fate"]),
                exception=_number(fields["exception"]),
                found=_number(fields["found"]),
            )
        unit_id, space, address = fields["worn"]
        return Worn(int(unit_id), Space(space), int(address, 16), tuple(_time(at) for at in fields["times"]))
    except (ValueError, TypeError, KeyError, OverflowError, RecursionError):
        return None


@dataclass(slots=True)
class Book:
    """What the records so far amount to."""

    worn: dict[Cell, list[float]] = field(default_factory=dict)
    open: dict[str, Intent] = field(default_factory=dict)  # by id, oldest first
    skipped: int = 0

    def read(self, lines: Iterable[bytes]) -> None:
        """Take in the lines of a file."""
        for line in lines:
            record = decode(line)
            if record is None:
                self.skipped += 1
            else:
                self.apply(record)

    def apply(self, record: Record) -> None:
        """Take in one record."""
        if isinstance(record, Intent):
            if record.id not in self.open and record.wears:
                self._wear(record.cell, record.at)
            self.open[record.id] = record
            while len(self.open) > MAX_OPEN:
                del self.open[next(iter(self.open))]
        elif isinstance(record, Worn):
            for at in record.times:
                self._wear((record.unit_id, record.space, record.address), at)
        elif record.fate is not Fate.UNKNOWN:
            intent = self.open.pop(record.id, None)
            if intent is not None and record.fate is Fate.NOT_SENT and intent.at in self.worn.get(intent.cell, ()):
                self.worn[intent.cell].remove(intent.at)

    def carried(self, now: float) -> Iterator[Record]:
        """What a new file begins with (rule 4); applied to an empty book it gives what this one knows."""
        for cell, times in self.worn.items():
            pending = [intent.at for intent in self.open.values() if intent.wears and intent.cell == cell]
            recent = [at for at in times if now - at < DAY_S]
            for at in pending:
                if at in recent:
                    recent.remove(at)  # comes with its intent
            if recent:
                yield Worn(*cell, tuple(recent))
        yield from self.open.values()

    def _wear(self, cell: Cell, at: float) -> None:
        times = self.worn.setdefault(cell, [])
        times.append(at)
        self.worn[cell] = [t for t in times if at - t < DAY_S]


@dataclass(slots=True)
class Entry:
    """An intent with its last verdict, for people."""

    intent: Intent
    verdict: Verdict | None


def entries(records: Iterable[Record]) -> list[Entry]:
    """The writes in the order in which they were intended; an intent that was carried over stands once."""
    found: dict[str, Entry] = {}
    for record in records:
        if isinstance(record, Intent):
            found.setdefault(record.id, Entry(record, None))
        elif isinstance(record, Verdict) and record.id in found:
            found[record.id].verdict = record
    return list(found.values())


def _text(at: float) -> str:
    return datetime.fromtimestamp(at, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


def _time(text: str) -> float:
    return datetime.fromisoformat(text).timestamp()


def _hex(number: int | None, digits: int = 4) -> str | None:
    return None if number is None else f"0x{number:0{digits}X}"


def _number(text: str | None) -> int | None:
    return None if text is None else int(text, 16)
