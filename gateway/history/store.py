"""What the history keeps of controllers and their days. Synchronous; one thread at a time.

Rule 1: a day is unique by controller and hourmeter, and is never deleted. Only when the same block of the ring comes
        back with the same hourmeter and other content (it was read while the controller wrote it) is it replaced.
Rule 2: what a harvest found is one transaction: days, position, look and the end of the staging.
Rule 3: whose ring it is, is decided in that transaction, by what is stored (identity.py).
Rule 4: a day is dated when it is first stored, because the look is closest then; later only while it has no date,
        or when the gateway's clock was set (`shift`).
Rule 5: who was in a place last is told by the looks. Where the clock says that a controller was looked at there later
        than the one that is there now, it was wrong at one of the looks, and the other one's is put before this one's.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path

from gateway.devices.model import LogLayout, WordOrder
from gateway.errors import HistoryError
from gateway.history.database import FILE_NAME, explained, open_database, set_aside, transaction
from gateway.history.dates import Look, estimate
from gateway.history.identity import Known, Place, Position, Seen, expected, owner
from gateway.history.ring import Apart, Day, Ring, Why, read_ring


@dataclass(frozen=True, slots=True)
class Plan:
    """Where a harvest begins: behind the newest day of the controller that should be there, or with what is staged."""

    controller: Known | None
    position: Position | None
    staged: Mapping[int, bytes]


@dataclass(frozen=True, slots=True)
class Kept:
    """What storing a harvest came to."""

    controller: Known
    new_days: int
    days: int  # of the controller, in all
    new_apart: tuple[Apart, ...]
    apart: int
    is_new: bool
    replaced: str | None  # the identity that was in its place until now, when it was another one


class Store:
    """The history in one directory; `session` is a number that no other run of the gateway has."""

    def __init__(self, directory: Path, session: int) -> None:
        """Open it; HistoryError when that cannot be."""
        self.path = directory / FILE_NAME
        self._directory = directory
        self._session = session
        self._db = open_database(directory)

    def close(self) -> None:
        """Close the file; what is committed is safe with or without."""
        self._db.close()

    def rescue(self, error: HistoryError) -> None:
        """Begin a new file after a "corrupt" error."""
        self._db.close()
        set_aside(self.path, str(error))
        self._db = open_database(self._directory)

    def counts(self, line: str, device: str) -> tuple[int, int, float | None]:
        """Days, blocks apart and last harvest (Unix time, None: never) of the controller last seen at a device."""
        with explained(self.path):
            last = self._last_at(line, device)
            return (0, 0, None) if last is None else (*self._counts(last.key), last.look.wall)

    def plan(self, seen: Seen, taken: Collection[int] = ()) -> Plan:
        """Where to begin with the controller that is seen."""
        with explained(self.path):
            controller = expected(self._controllers(seen.model), seen, taken)
            position = None if controller is None else controller.position
            return Plan(controller, position, self._staged(seen))

    def stage(self, seen: Seen, blocks: Mapping[int, bytes], *, first: bool) -> None:
        """Keep blocks of a ring that is being read whole; with `first`, instead of what is staged of the device."""
        device = seen.place.device
        with explained(self.path):
            self._db.execute("PRAGMA synchronous = NORMAL")  # rule 1 of database.py
            try:
                with transaction(self._db):
                    if first:
                        self._unstage(device)
                    self._db.execute(
                        "INSERT INTO staging VALUES (?, ?, ?, ?, ?, ?) "
                        "ON CONFLICT (device) DO UPDATE SET look_hours = excluded.look_hours",
                        (device, seen.place.line, seen.model, seen.product, seen.serial, seen.look.hours),
                    )
                    self._db.executemany(
                        "INSERT OR REPLACE INTO staged VALUES (?, ?, ?)",
                        [(device, slot, words) for slot, words in blocks.items()],
                    )
            finally:
                self._db.execute("PRAGMA synchronous = FULL")

    def keep_ring(
        self,
        seen: Seen,
        layout: LogLayout,
        blocks: Mapping[int, bytes],
        taken: Collection[int] = (),
        *,
        whole: bool = True,
    ) -> Kept:
        """Store a ring that was read whole, or all of it that could be read (`whole` is False: read it again)."""
        ring = read_ring(layout, blocks, seen.look.hours)
        with explained(self.path), transaction(self._db):
            controllers = self._controllers(seen.model)
            mine = owner(controllers, seen, ring, self._common(seen.model, ring), taken)
            position = self._position(ring) if whole else None
            kept = self._keep(seen, mine, ring, position)
            self._unstage(seen.place.device)
        return kept

    def keep_newer(self, seen: Seen, layout: LogLayout, known: Known, blocks: Mapping[int, bytes]) -> Kept:
        """Store the days behind the position of a controller whose newest day was found in its place."""
        assert known.position is not None
        ring = read_ring(layout, blocks, seen.look.hours, known.position.order)
        with explained(self.path), transaction(self._db):
            newest = self._position(ring)
            later = newest is not None and newest.hourmeter > known.position.hourmeter
            kept = self._keep(seen, known, ring, newest if later else known.position)
            self._unstage(seen.place.device)
        return kept

    def shift(self, keys: Collection[int], step_s: float) -> int:
        """The gateway's clock was set forward by `step_s`: move the dates this session made; gives how many.

        `keys` are the controllers that it looked at, as far as known: those with a day of it are found by that.
        """
        with explained(self.path), transaction(self._db):
            dated = self._db.execute(
                "SELECT DISTINCT controller FROM day WHERE session = ?", (self._session,)
            ).fetchall()
            moved = self._db.execute(
                "UPDATE day SET written_wall = written_wall + ?, read_wall = read_wall + ? WHERE session = ?",
                (step_s, step_s, self._session),
            ).rowcount
            self._db.executemany(
                "UPDATE controller SET look_wall = look_wall + ? WHERE key = ?",
                [(step_s, key) for key in {*keys, *(key for (key,) in dated)}],
            )
        return moved

    def _controllers(self, model: str) -> list[Known]:
        rows = self._db.execute(
            "SELECT key, identity, c.model, product, serial, line, device, unit_id, look_hours, look_wall, "
            "newest_slot, newest_hourmeter, c.word_order, words FROM controller c "
            "LEFT JOIN day ON day.controller = key AND day.hourmeter = newest_hourmeter WHERE c.model = ?",
            (model,),
        )
        return [
            Known(
                key,
                identity,
                of_model,
                product,
                serial,
                Place(line, device, unit_id),
                Look(hours, wall),
                None if words is None else Position(slot, hourmeter, bytes(words), WordOrder(order)),
            )
            for (
                key, identity, of_model, product, serial, line, device, unit_id,
                hours, wall, slot, hourmeter, order, words,
            ) in rows
        ]  # fmt: skip

    def _last_at(self, line: str, device: str) -> Known | None:
        row = self._db.execute(
            "SELECT model, key FROM controller WHERE line = ? AND device = ? ORDER BY look_wall DESC, key DESC LIMIT 1",
            (line, device),
        ).fetchone()
        return None if row is None else next(known for known in self._controllers(row[0]) if known.key == row[1])

    def _staged(self, seen: Seen) -> dict[int, bytes]:
        row = self._db.execute(
            "SELECT line, model, product, serial, look_hours FROM staging WHERE device = ?", (seen.place.device,)
        ).fetchone()
        if row is None:
            return {}
        *who, hours = row
        if who != [seen.place.line, seen.model, seen.product, seen.serial] or hours > seen.look.hours:
            return {}
        rows = self._db.execute("SELECT slot, words FROM staged WHERE device = ?", (seen.place.device,))
        return {slot: bytes(words) for slot, words in rows}

    def _unstage(self, device: str) -> None:
        self._db.execute("DELETE FROM staging WHERE device = ?", (device,))

    def _common(self, model: str, ring: Ring) -> dict[int, int]:
        """By controller, how many of its days are blocks of the ring."""
        if not ring.days:
            return {}
        words = {day.hourmeter: day.words for day in ring.days}
        rows = self._db.execute(
            "SELECT controller, hourmeter, words FROM day JOIN controller ON key = controller "
            "WHERE model = ? AND hourmeter BETWEEN ? AND ?",
            (model, min(words), max(words)),
        )
        common: dict[int, int] = {}
        for key, hourmeter, stored in rows:
            if words.get(hourmeter) == stored:
                common[key] = common.get(key, 0) + 1
        return common

    @staticmethod
    def _position(ring: Ring) -> Position | None:
        newest = ring.days[-1] if ring.days else None
        return None if newest is None else Position(newest.slot, newest.hourmeter, newest.words, ring.order)

    def _keep(self, seen: Seen, known: Known | None, ring: Ring, position: Position | None) -> Kept:
        before = self._last_at(seen.place.line, seen.place.device)
        key = self._insert_controller(seen) if known is None else known.key
        look_before = None if known is None else known.look
        new_days = 0
        tied: list[Apart] = []
        for day in ring.days:
            outcome = self._insert_day(key, day, ring.order, seen.look.wall)
            new_days += outcome is True
            if outcome is None:
                tied.append(Apart(day.slot, day.hourmeter, day.words, Why.TIE))
        self._date(key, seen.look, look_before)
        self._db.execute(  # a block that has turned out to be a day
            "DELETE FROM apart WHERE controller = ? AND EXISTS (SELECT 1 FROM day WHERE day.controller = "
            "apart.controller AND day.hourmeter = apart.hourmeter AND day.words = apart.words)",
            (key,),
        )
        new_apart = tuple(block for block in (*ring.apart, *tied) if self._insert_apart(key, block, seen.look.wall))
        self._db.execute(
            "UPDATE controller SET product = ?, revision = ?, serial = ?, line = ?, device = ?, unit_id = ?, "
            "look_wall = ?, look_hours = ?, word_order = ?, newest_slot = ?, newest_hourmeter = ? WHERE key = ?",
            (
                seen.product or (known.product if known else ""),
                seen.revision,
                seen.serial or (known.serial if known else ""),
                seen.place.line,
                seen.place.device,
                seen.place.unit_id,
                seen.look.wall,
                seen.look.hours,
                ring.order.value,
                None if position is None else position.slot,
                None if position is None else position.hourmeter,
                key,
            ),
        )
        self._db.execute(  # rule 5
            "UPDATE controller SET look_wall = ? WHERE line = ? AND device = ? AND key != ? AND look_wall >= ?",
            (seen.look.wall - 1.0, seen.place.line, seen.place.device, key, seen.look.wall),
        )
        controller = next(known for known in self._controllers(seen.model) if known.key == key)
        replaced = before.identity if before is not None and before.key != key else None
        days, apart = self._counts(key)
        return Kept(controller, new_days, days, new_apart, apart, known is None, replaced)

    def _insert_controller(self, seen: Seen) -> int:
        stem = f"{seen.model}/{seen.serial}" if seen.serial else f"{seen.place.line}/{seen.place.device}"
        identities = {row[0] for row in self._db.execute("SELECT identity FROM controller")}
        identity, number = stem, 1
        while identity in identities:
            number += 1
            identity = f"{stem}/{number}"
        cursor = self._db.execute(
            "INSERT INTO controller (identity, model, product, revision, serial, line, device, unit_id, first_wall, "
            "look_wall, look_hours, word_order) VALUES (?, ?, '', '', '', '', '', 0, ?, ?, ?, '')",
            (identity, seen.model, seen.look.wall, seen.look.wall, seen.look.hours),
        )
        assert cursor.lastrowid is not None
        return cursor.lastrowid

    def _insert_day(self, key: int, day: Day, order: WordOrder, wall: float) -> bool | None:
        """Whether the day is new; None when another block has its hourmeter."""
        row = self._db.execute(
            "SELECT slot, words FROM day WHERE controller = ? AND hourmeter = ?", (key, day.hourmeter)
        ).fetchone()
        fields = json.dumps(dict(day.values))
        if row is None:
            self._db.execute(
                "INSERT INTO day VALUES (?, ?, ?, ?, ?, ?, ?, ?, NULL, NULL)",
                (key, day.hourmeter, day.slot, day.words, order.value, fields, wall, self._session),
            )
            return True
        slot, words = row
        if words != day.words and slot != day.slot:
            return None
        if words != day.words:
            self._db.execute(
                "UPDATE day SET words = ?, word_order = ?, fields = ? WHERE controller = ? AND hourmeter = ?",
                (day.words, order.value, fields, key, day.hourmeter),
            )
        return False

    def _date(self, key: int, look: Look, before: Look | None) -> None:
        """Date the days that have no date (rule 4)."""
        rows = self._db.execute(
            "SELECT hourmeter FROM day WHERE controller = ? AND written_wall IS NULL", (key,)
        ).fetchall()
        dated = [(hourmeter, estimate(hourmeter, look, before)) for (hourmeter,) in rows]
        self._db.executemany(
            "UPDATE day SET written_wall = ?, error_s = ?, session = ? WHERE controller = ? AND hourmeter = ?",
            [(date.at, date.error_s, self._session, key, hourmeter) for hourmeter, date in dated if date is not None],
        )

    def _insert_apart(self, key: int, block: Apart, wall: float) -> bool:
        cursor = self._db.execute(
            "INSERT OR IGNORE INTO apart VALUES (?, ?, ?, ?, ?, ?)",
            (key, block.slot, block.words, block.hourmeter, block.why.value, wall),
        )
        return cursor.rowcount > 0

    def _counts(self, key: int) -> tuple[int, int]:
        (days,) = self._db.execute("SELECT count(*) FROM day WHERE controller = ?", (key,)).fetchone()
        (apart,) = self._db.execute("SELECT count(*) FROM apart WHERE controller = ?", (key,)).fetchone()
        return days, apart
