"""The ledger's lines, and what follows from them."""

from __future__ import annotations

import json
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.core.write_ledger import MAX_OPEN, Book, Fate, Intent, Record, Verdict, Worn, decode, encode, entries
from gateway.core.write_wear import DAY_S
from gateway.devices.model import Space

NOW = 1_800_000_000.0
TIMES = st.integers(0, 4_000_000_000_000).map(lambda ms: ms / 1000)
TEXT = st.text(max_size=20)
WORD = st.integers(0, 0xFFFF)
MAYBE = st.none() | WORD
INTENTS = st.builds(
    Intent,
    id=TEXT,
    at=TIMES,
    peer=TEXT,
    role=st.none() | TEXT,
    unit_id=st.integers(1, 247),
    device=TEXT,
    point=TEXT,
    space=st.sampled_from(Space),
    address=WORD,
    old=MAYBE,
    new=WORD,
    wears=st.booleans(),
    left_out=st.integers(0, 10**6),
)
VERDICTS = st.builds(Verdict, id=TEXT, at=TIMES, fate=st.sampled_from(Fate), exception=MAYBE, found=MAYBE)
WORN = st.builds(
    Worn,
    unit_id=st.integers(1, 247),
    space=st.sampled_from(Space),
    address=WORD,
    times=st.lists(TIMES, max_size=4).map(tuple),
)


def intent(id_: str = "a", at: float = NOW, *, address: int = 0xE000, wears: bool = True) -> Intent:
    return Intent(id_, at, "192.0.2.7", None, 11, "array-1", "float_voltage", Space.REGISTERS, address, 1, 2, wears)


def book(*records: Record) -> Book:
    made = Book()
    made.read(map(encode, records))
    return made


@given(record=INTENTS | VERDICTS | WORN)
def test_a_line_is_one_record_and_back(record: Record) -> None:
    line = encode(record)
    assert line.count(b"\n") == 1
    assert line.endswith(b"\n")
    json.loads(line)
    again = decode(line)
    assert type(again) is type(record)
    if isinstance(record, Worn):
        assert isinstance(again, Worn)
        assert all(math.isclose(a, b, abs_tol=0.0011) for a, b in zip(again.times, record.times, strict=True))
    else:
        assert not isinstance(again, Worn)
        assert again is not None
        assert math.isclose(again.at, record.at, abs_tol=0.0011)
        assert encode(again) == line


@given(line=st.binary(max_size=80) | st.text(max_size=80).map(str.encode))
def test_anything_else_is_skipped(line: bytes) -> None:
    assert decode(line) is None


@given(record=INTENTS | VERDICTS, cut=st.integers(1, 400), rest=st.lists(INTENTS, max_size=2))
def test_a_line_that_was_cut_off_hides_no_other(record: Record, cut: int, rest: list[Intent]) -> None:
    torn = encode(record)[: -1 - cut] + b"\n"
    made = Book()
    made.read([torn, *map(encode, rest)])
    assert list(made.open) == list(dict.fromkeys(each.id for each in rest))
    assert made.skipped <= 1


@pytest.mark.parametrize("line", ["[]", "{}", "1", "null", '{"intended":"a"}', '{"worn":[1]}', "[" * 100_000])
def test_json_that_is_no_record_is_skipped(line: str) -> None:
    assert decode(line.encode()) is None


def test_an_intent_is_open_until_somebody_knows() -> None:
    made = book(intent("a"), intent("b"), Verdict("a", NOW, Fate.UNKNOWN, 0x0B), Verdict("b", NOW, Fate.WRITTEN))
    assert list(made.open) == ["a"]
    made.apply(Verdict("a", NOW, Fate.DIFFERS, found=3))
    assert not made.open


def test_f44_wear_is_counted_from_the_ledger_unless_a_write_was_not_sent() -> None:
    cell = (11, Space.REGISTERS, 0xE000)
    made = book(
        intent("a"),
        Verdict("a", NOW, Fate.WRITTEN),
        intent("b", NOW + 1),
        Verdict("b", NOW + 1, Fate.NOT_SENT),
        intent("c", NOW + 2),
        Verdict("c", NOW + 2, Fate.UNKNOWN),
        intent("d", NOW + 3, wears=False),
    )
    assert made.worn == {cell: [NOW, NOW + 2]}
    made.apply(intent("e", NOW + DAY_S + 1))
    assert made.worn == {cell: [NOW + 2, NOW + DAY_S + 1]}


@given(
    records=st.lists(
        st.tuples(st.sampled_from("abcdef"), st.integers(0, 2000), st.none() | st.sampled_from(Fate)), max_size=30
    )
)
def test_a_new_file_begins_with_all_that_is_needed(records: list[tuple[str, int, Fate | None]]) -> None:
    made, seen = Book(), set[str]()
    for id_, minute, fate in records:
        if id_ not in seen:
            seen.add(id_)
            made.apply(intent(id_, NOW + 60.0 * minute, address=0xE000 + minute % 3, wears=minute % 2 == 0))
        if fate is not None:
            made.apply(Verdict(id_, NOW, fate))
    now = NOW + 60.0 * 2000
    again = book(*made.carried(now))
    assert again.open == made.open
    recent = {cell: sorted(at for at in times if now - at < DAY_S) for cell, times in made.worn.items()}
    wanted = {cell: times for cell, times in recent.items() if times}
    found = {cell: sorted(at for at in times if now - at < DAY_S) for cell, times in again.worn.items()}
    assert {cell: times for cell, times in found.items() if times} == wanted


def test_open_intents_are_bounded() -> None:
    made = book(*(intent(f"{n}") for n in range(MAX_OPEN + 5)))
    assert len(made.open) == MAX_OPEN
    assert "4" not in made.open


def test_entries_are_for_people_each_write_once_with_its_last_verdict() -> None:
    found = entries(
        [
            intent("a"),
            Verdict("a", NOW, Fate.UNKNOWN, 0x0B),
            Worn(11, Space.REGISTERS, 0xE000, (NOW,)),
            intent("a"),  # carried over
            intent("b"),
            Verdict("a", NOW + 9, Fate.NOT_WRITTEN, found=1),
            Verdict("gone", NOW, Fate.WRITTEN),
        ]
    )
    assert [(entry.intent.id, entry.verdict and entry.verdict.fate) for entry in found] == [
        ("a", Fate.NOT_WRITTEN),
        ("b", None),
    ]
