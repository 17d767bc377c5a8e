"""What happens to the first of two controllers, its line, its clients or the gateway; each cause ends by itself."""

from __future__ import annotations

from collections.abc import Callable

from gateway.core.snapshot import DeviceState
from tests.faults.pairs.rig import NEWCOMER, OTHER, TARGET, PairRig

Cause = Callable[[PairRig], object]
WHO_ARE_YOU, SERIAL_NUMBER = b"\x2b", b"\x03\xe0\x80"


def _answers(code: int, seconds: float = 3.0) -> Cause:
    def cause(rig: PairRig) -> None:
        unit = rig.own[TARGET]
        unit.exception = code
        rig.later(seconds, "answers again", lambda: setattr(unit, "exception", None))

    return cause


def _swapped(name: str) -> Cause:
    def cause(rig: PairRig) -> None:
        rig.place(None)
        rig.later(15.0, f"{name} is plugged in", lambda: rig.place(getattr(rig, name)))
        rig.later(27.0, "is unplugged", lambda: rig.place(None))
        rig.later(43.0, "the right one is back", lambda: rig.place(rig.own[TARGET]))

    return cause


def _power_lost(rig: PairRig) -> None:
    unit = rig.own[TARGET]
    unit.silent = True

    def back() -> None:
        unit.silent = False
        if rig.knows(TARGET):
            unit.lose_power(rig.now)

    rig.later(9.0, "has power again", back)


def _taken_away(rig: PairRig) -> None:
    rig.rebuild((OTHER,), 0.3)
    rig.later(4.0, "is configured again", lambda: rig.rebuild(tuple(sorted({*rig.devices, TARGET, OTHER})), 0.3))


def _clock_step(rig: PairRig) -> None:
    rig.wall += 86_400 * (365 if rig.wall < 1.71e9 else -730)


def _clients(rig: PairRig) -> None:
    for client in "bcd":
        for address in (TARGET, OTHER):
            for first in (0x8000, 0x8010, 0x0004, 0xE000):
                rig.read(address, first, 4, client)
    rig.read(TARGET, 0x0100, 2, "b")  # what no such unit has


CAUSES: dict[str, Cause] = {
    "lost": lambda rig: rig.spoilt.next(TARGET, "lost"),
    "lost 4": lambda rig: rig.spoilt.next(TARGET, *["lost"] * 4),
    "late": lambda rig: rig.spoilt.next(TARGET, "late"),
    "late 3": lambda rig: rig.spoilt.next(TARGET, *["late"] * 3),
    "very late": lambda rig: rig.spoilt.next(TARGET, "very late"),
    "corrupt": lambda rig: rig.spoilt.next(TARGET, "corrupt"),
    "foreign": lambda rig: rig.spoilt.next(TARGET, "foreign"),
    "answers 02": _answers(0x02),
    "answers 04": _answers(0x04),
    "answers 06": _answers(0x06),
    "another unit": _swapped("alike"),
    "another model": _swapped("other_model"),
    "power lost": _power_lost,
    "line lost": lambda rig: rig.close(0.5),
    "line lost for long": lambda rig: rig.close(8.0),
    "write": lambda rig: rig.write(),
    "two writes": lambda rig: (rig.write(), rig.write_raw()),
    "write of another": lambda rig: rig.write(OTHER),
    "restart": lambda rig: rig.rebuild(None, 1.0),
    "clock step": _clock_step,
    "sleep": lambda rig: rig.sleep(3600.0),
    "taken away": _taken_away,
    "added": lambda rig: rig.rebuild(tuple(sorted({*rig.devices, NEWCOMER})), 0.3),
    "clients": _clients,
}
UPSTREAM_CAUSES: dict[str, Cause] = {
    **CAUSES,
    "closed": lambda rig: rig.spoilt.next(TARGET, "close"),
    "reset": lambda rig: rig.reset(),
}


def _asked(rig: PairRig) -> int:
    """How often the target was asked."""
    sent = rig.line.sent
    return sum((each[0] if isinstance(each, bytes) else each.unit) == TARGET for _, each in sent)


def _sent(rig: PairRig) -> None:
    before = len(rig.line.sent)

    def is_sent() -> bool:
        new = [each for _, each in rig.line.sent[before:]]
        return any((each[0] if isinstance(each, bytes) else each.unit) == TARGET for each in new)

    rig.until(is_sent, 3.0)


def _ended(rig: PairRig) -> None:
    _sent(rig)
    rig.until(lambda: not rig.engine.busy, 3.0)


def _replying(rig: PairRig) -> None:
    _sent(rig)
    rig.run(0.06)


def _until_asked(rig: PairRig, what: bytes) -> None:
    before = len(rig.line.sent)

    def is_sent() -> bool:
        pdus = [e[1:] if isinstance(e, bytes) else e.pdu for _, e in rig.line.sent[before:]]
        return any(pdu.startswith(what) for pdu in pdus)

    rig.until(is_sent, 5.0)


def _identity(what: bytes) -> Cause:
    def phase(rig: PairRig) -> None:
        rig.close(0.3)
        _until_asked(rig, what)

    return phase


def _stranger_at_start(rig: PairRig) -> None:
    """Nothing is known of the right unit but what is configured."""
    rig.place(None)
    rig.run(16.0)
    rig.place(rig.alike)
    rig.rebuild(None, 0.3)
    rig.later(20.0, "is unplugged", lambda: rig.place(None))
    rig.later(36.0, "the right one is there", lambda: rig.place(rig.own[TARGET]))
    _until_asked(rig, SERIAL_NUMBER)


def _quarantine(rig: PairRig) -> None:
    rig.spoilt.next(TARGET, "lost")
    failed = rig.engine.stats.failed.total()
    rig.until(lambda: rig.engine.stats.failed.total() > failed, 5.0)


def _offline(rig: PairRig) -> None:
    unit = rig.own[TARGET]
    unit.silent = True
    rig.until(lambda: rig.devices[TARGET].snapshot.state is DeviceState.OFFLINE, 20.0, 0.05)
    rig.later(4.0, "speaks again", lambda: setattr(unit, "silent", False))


def _idle(rig: PairRig) -> None:
    def idle() -> bool:
        due = rig.engine.next_deadline(rig.now)
        return not rig.engine.busy and (due is None or due > rig.now + 0.1)

    rig.until(idle, 5.0)


def _before(rig: PairRig) -> None:
    _idle(rig)
    due = rig.engine.next_deadline(rig.now)
    if due is not None:
        rig.run(max(0.0, due - rig.now - 0.001))


PHASES: dict[str, Cause] = {
    "idle": _idle,
    "before a request": _before,
    "on the wire": _sent,
    "under the reply": _replying,
    "after it": _ended,
    "who are you": _identity(WHO_ARE_YOU),
    "serial number": _identity(SERIAL_NUMBER),
    "serial number of another unit": _stranger_at_start,
    "quarantine": _quarantine,
    "offline": _offline,
}
GAPS: dict[str, Cause] = {
    "at once": lambda rig: None,
    "on the wire": _sent,
    "under the reply": _replying,
    "after it": _ended,
    "0.7 s": lambda rig: rig.run(0.7),
    "3 s": lambda rig: rig.run(3.0),
    "16 s": lambda rig: rig.run(16.0),
}


def happen(rig: PairRig, *steps: tuple[str, Cause]) -> None:
    """Let these happen one after another, while clients read."""
    _traffic(rig)
    for what, act in steps:
        rig.story.append(f"{rig.now:.3f} * {what}")
        act(rig)
    rig.traffic = False
    rig.recover()


def _traffic(rig: PairRig) -> None:
    number = 0

    def ask() -> None:
        nonlocal number
        number += 1
        rig.read(TARGET, (0x0000, 0x8000, 0xE000, 0x0010)[number % 4], 4 + number % 3)
        rig.read(OTHER, (0x8004, 0x0010)[number % 2], 5)
        if rig.traffic:
            rig.later(0.9, "clients ask", ask)

    rig.later(0.3, "clients ask", ask)
