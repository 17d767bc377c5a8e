"""Which requests may follow an unanswered one, for a device that answers in order, as late as it likes."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from gateway.core.doubt import Doubt

FUNCTIONS = (3, 1, 4, 2, 0x2B)


def test_an_answer_to_another_function_settles_all_that_is_older() -> None:
    doubt = Doubt()
    doubt.missed(3)
    doubt.missed(1)
    assert not doubt.allows(3)
    assert not doubt.allows(1)
    doubt.answered(4)
    assert all(doubt.allows(function) for function in FUNCTIONS)


def test_an_answer_to_a_function_in_doubt_settles_only_what_is_older_than_it() -> None:
    doubt = Doubt()
    for function in (3, 1, 4):
        doubt.missed(function)
    doubt.answered(1)
    assert doubt.allows(3)
    assert not doubt.allows(1)
    assert not doubt.allows(4)


def test_the_small_question_is_of_a_free_function_else_of_the_one_last_in_doubt() -> None:
    doubt = Doubt()
    assert doubt.choose(FUNCTIONS) == 3
    for function in (3, 1, 0x2B, 4):
        doubt.missed(function)
    assert doubt.choose(FUNCTIONS) == 2
    doubt.missed(2)
    doubt.missed(3)
    assert doubt.choose(FUNCTIONS) == 2


@given(
    script=st.lists(
        st.tuples(st.sampled_from(FUNCTIONS), st.sampled_from(("answered", "late", "lost")), st.integers(0, 3)),
        min_size=1,
        max_size=60,
    )
)
def test_no_late_reply_is_ever_taken_for_a_real_question(script: list[tuple[int, str, int]]) -> None:
    """The device keeps its replies in order and lets them out whenever the script says, or never.

    A client that takes the first reply of the right function for its own is never wrong about a request that
    `allows` let out; about a small question (it goes out in any case) it may be, as rule 4 says.
    """
    doubt = Doubt()
    under_way: list[tuple[int, int]] = []  # (number of the request, its function), in order
    number = 0

    def ask(function: int, fate: str) -> int | None:
        """Put a question; gives the number of the request whose reply was taken, None when none came in time."""
        nonlocal number
        number += 1
        if fate != "lost":
            under_way.append((number, function))
        if fate != "answered":
            doubt.missed(function)
            return None
        while True:
            taken, of = under_way.pop(0)
            if of == function:
                doubt.answered(function)
                return taken

    for function, fate, seen_off in script:
        del under_way[:seen_off]  # replies that came while nobody waited
        for _ in FUNCTIONS:
            if not doubt.allows(function):
                ask(doubt.choose(FUNCTIONS), fate)
        if doubt.allows(function):
            assert ask(function, fate) in {None, number}
        else:
            assert fate != "answered", "a device that answers is asked on"
