"""Random writes, faults, kills and days: what must hold of all of them."""

from __future__ import annotations

from collections import Counter

from hypothesis import given, settings
from hypothesis import strategies as st

from gateway.core.site import Outcome
from gateway.core.write_ledger import Book, Fate, Intent, encode, entries
from gateway.core.write_request import SingleWrite
from gateway.core.write_wear import DAY_S, Wear, WearLimits
from gateway.core.writing import Note, Read, Step, Write
from gateway.errors import LineDown, QueueFull, ReplyCrcError, ReplyTimeout
from tests.core.test_writing import Bench

PER_DAY = 3
FIRST = 0xE000
FAULTS = ("heard", "swallowed", "garbled", "closed", "full", "exception", "lies", "disk", "kill")


class Killed(Exception):
    """The process is gone."""


class Chaos(Bench):
    """A bench on which steps fail as drawn; `went_out` are the writes that left the gateway, with their times."""

    def __init__(self) -> None:
        super().__init__()
        self.lines: list[bytes] = []  # what is on the disk
        self.went_out: list[tuple[float, int, int]] = []
        self.noted: Counter[SingleWrite] = Counter()
        self.sent: Counter[SingleWrite] = Counter()
        self.plan: list[str | None] = []
        self.restart()

    def restart(self) -> None:
        """A new process, which knows what is on the disk."""
        self.book = Book()
        self.book.read(self.lines)
        self.wear = Wear(WearLimits(per_day=PER_DAY, interval_s=0.0))
        for cell, times in self.book.worn.items():
            for at in times:
                self.wear.restore(cell, self.now - at, self.now)

    def answer(self, step: Step) -> Outcome:
        fault = self.plan.pop(0) if self.plan else None
        if fault == "kill":
            raise Killed
        if isinstance(step, Note):
            if fault == "disk" and step.before:
                self.disk_full = True
            outcome = super().answer(step)
            if not self.disk_full:
                self.lines += map(encode, step.records)
                self.noted.update(SingleWrite(r.space, r.address, r.new) for r in step.records if isinstance(r, Intent))
            self.disk_full = False
            return outcome
        if isinstance(step, Write):
            if fault == "full":
                return QueueFull()
            self.went_out.append((self.now, step.write.address, step.write.value))
            self.sent[step.write] += 1
            assert self.sent[step.write] <= self.noted[step.write], "what goes out stands on the disk"
        return self.failed(fault, step)

    def failed(self, fault: str | None, step: Read | Write) -> Outcome:
        pdu = step.pdu if isinstance(step, Read) else step.write.encode()
        if fault in {"swallowed", "closed"}:
            return ReplyTimeout() if fault == "swallowed" else LineDown()
        if fault == "exception":
            return bytes((pdu[0] | 0x80, 4))
        if fault == "lies" and isinstance(step, Write):
            return pdu
        reply = self.unit.handle(pdu, self.now)
        assert reply is not None
        return ReplyTimeout() if fault == "heard" else ReplyCrcError() if fault == "garbled" else reply


REQUESTS = st.tuples(
    st.integers(0, 1),  # the first register
    st.lists(st.integers(0x4A00, 0x4A03), min_size=1, max_size=2),
    st.just([]) | st.lists(st.none() | st.sampled_from(FAULTS), max_size=6),
    st.sampled_from([1.0, 600.0, 3600.0, 20_000.0]),  # seconds until the next
)


@settings(max_examples=40)
@given(requests=st.lists(REQUESTS, min_size=8, max_size=25))
def test_whatever_happens(requests: list[tuple[int, list[int], list[str | None], float]]) -> None:
    bench = Chaos()
    for number, (first, values, plan, wait_s) in enumerate(requests):
        pdu = f"10 {FIRST + first:04X} {len(values):04X} {2 * len(values):02X} " + "".join(f"{v:04X}" for v in values)
        bench.plan = list(plan)
        before = len(bench.went_out)
        try:
            result = bench.write(pdu, f"{number}")
        except Killed:
            bench.restart()
        else:
            sent = [value for _, _, value in bench.went_out[before:]]
            assert len(sent) <= len(values)
            if isinstance(result.outcome, bytes) and result.outcome[0] == 0x10:
                assert [bench.holds(FIRST + first + at) for at in range(len(values))] == values
        bench.now += wait_s

    for at, address, _ in bench.went_out:
        day = [1 for other, same, _ in bench.went_out if same == address and at <= other < at + DAY_S]
        assert len(day) <= PER_DAY

    bench.restart()
    bench.plan = []
    bench.settle(*bench.book.open.values())
    bench.restart()
    assert not bench.book.open, "somebody knows of each how it ended"
    found = entries(bench.records)
    last = {entry.intent.address: entry for entry in found if entry.verdict and entry.verdict.fate is Fate.WRITTEN}
    for address, entry in last.items():
        later = [e for e in found[found.index(entry) + 1 :] if e.intent.address == address]
        if all(e.verdict is not None and e.verdict.fate in {Fate.NOT_SENT, Fate.REFUSED} for e in later):
            assert bench.holds(address) == entry.intent.new
