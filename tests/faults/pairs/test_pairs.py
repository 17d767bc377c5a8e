"""Two causes, one after the other: most of what went wrong lately went wrong between two that are harmless alone.

Every ordered pair begins at some moment of a line's life, and its second cause comes at some moment after the first.
What must hold is in rig.py. A tier takes those moments in turn, so that all pairs together meet all of them.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import cycle, product

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.faults.pairs.causes import CAUSES, GAPS, PHASES, UPSTREAM_CAUSES, Cause, happen
from tests.faults.pairs.judge import Broken
from tests.faults.pairs.rig import PairRig

LONG_TO_MEND = "answers 02"
"""What was refused in this way is asked for again after ten minutes only."""
KINDS = [
    pytest.param(upstream, first, id=f"{'upstream' if upstream else 'serial'}: {first}")
    for upstream, causes in ((False, CAUSES), (True, UPSTREAM_CAUSES))
    for first in causes
]


STARTS = {"restart", "taken away", "added", "serial number of another unit"}
"""After these a unit is only told from another one by what is configured of it."""


def try_pair(first: str, second: str, phase: str, gap: str, *, upstream: bool, configured: bool = True) -> None:
    rig = PairRig(upstream=upstream, configured=configured)
    rig.run(6.0)
    causes = UPSTREAM_CAUSES
    steps = ((phase, PHASES[phase]), (first, causes[first]), (gap, GAPS[gap]), (second, causes[second]))
    try:
        happen(rig, *steps)
    except Broken as error:
        error.add_note(f"{first}, then {second}; {phase}, then {gap}; upstream: {upstream}")
        raise


def moments(start: int) -> Iterator[tuple[str, str]]:
    """Phases and gaps in turn; as their numbers have no common divisor, all pairs of them."""
    phases, gaps = cycle(PHASES), cycle(GAPS)
    for _ in range(start):
        next(phases), next(gaps)
    return zip(phases, gaps, strict=False)


@pytest.mark.parametrize(("upstream", "first"), [kind for kind in KINDS if LONG_TO_MEND not in kind.values])
def test_some_pairs(upstream: bool, first: str) -> None:
    causes: Mapping[str, Cause] = UPSTREAM_CAUSES if upstream else CAUSES
    names = [name for name in causes if name != LONG_TO_MEND]
    at = list(causes).index(first)
    step = 8 if upstream else 4
    for second, (phase, gap) in zip(names[at % step :: step], moments(7 * at), strict=False):
        try_pair(first, second, phase, gap, upstream=upstream)


def test_a_unit_that_told_a_part_of_its_memory_only_and_lost_its_power() -> None:
    try_pair(LONG_TO_MEND, "power lost", "who are you", "16 s", upstream=False)


@pytest.mark.parametrize("upstream", [False, True], ids=["serial", "upstream"])
@pytest.mark.parametrize("end", ["line lost", "restart", "taken away"])
def test_a_write_and_the_end_of_its_line(end: str, upstream: bool) -> None:
    for gap in GAPS:
        try_pair("two writes", end, "idle", gap, upstream=upstream)


@pytest.mark.long
@pytest.mark.parametrize(("upstream", "first"), KINDS)
def test_every_pair_at_every_phase(upstream: bool, first: str) -> None:
    causes: Mapping[str, Cause] = UPSTREAM_CAUSES if upstream else CAUSES
    for number, second in enumerate(causes):
        when = list(zip(range(len(PHASES)), moments(number), strict=False))
        for _, (phase, gap) in when[:1] if LONG_TO_MEND in {first, second} else when:
            try_pair(first, second, phase, gap, upstream=upstream)


@pytest.mark.long
@pytest.mark.parametrize("upstream", [False, True], ids=["serial", "upstream"])
def test_every_pair_where_a_unit_is_known_by_what_it_told_before(upstream: bool) -> None:
    causes: Mapping[str, Cause] = UPSTREAM_CAUSES if upstream else CAUSES
    pairs = product(causes.keys() - STARTS - {LONG_TO_MEND}, repeat=2)
    for (first, second), (phase, gap) in zip(sorted(pairs), moments(0), strict=False):
        if phase not in STARTS:
            try_pair(first, second, phase, gap, upstream=upstream, configured=False)


STEPS = st.lists(
    st.tuples(st.sampled_from(sorted(UPSTREAM_CAUSES.keys() - {LONG_TO_MEND})), st.sampled_from(sorted(GAPS))),
    min_size=3,
    max_size=6,
)


def try_many(steps: list[tuple[str, str]], phase: str, *, upstream: bool) -> None:
    rig = PairRig(upstream=upstream)
    rig.run(6.0)
    causes = [(name, gap) for name, gap in steps if upstream or name in CAUSES]
    happen(
        rig,
        (phase, PHASES[phase]),
        *(each for name, gap in causes for each in ((name, UPSTREAM_CAUSES[name]), (gap, GAPS[gap]))),
    )


@settings(max_examples=20)
@given(steps=STEPS, phase=st.sampled_from(sorted(PHASES)), upstream=st.booleans())
def test_more_than_two(steps: list[tuple[str, str]], phase: str, upstream: bool) -> None:
    try_many(steps, phase, upstream=upstream)


@pytest.mark.long
@settings(max_examples=1000)
@given(steps=STEPS, phase=st.sampled_from(sorted(PHASES)), upstream=st.booleans())
def test_many_times_more_than_two(steps: list[tuple[str, str]], phase: str, upstream: bool) -> None:
    try_many(steps, phase, upstream=upstream)
