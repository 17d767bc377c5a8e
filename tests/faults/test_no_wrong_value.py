"""No wrong value, whatever the line does: thousands of transactions under every kind of fault, judged by the oracle.

What the rules of core/doubt.py are worth is shown by taking them away: then the same runs give wrong values.
"""

from __future__ import annotations

from pathlib import Path
from random import Random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.core.doubt import Doubt
from gateway.core.settings import PollSettings
from gateway.modbus.pdu import read_identification_request
from gateway.simulator.chaos import LINE_FAULTS, Chaos, Fault, Spans, all_at
from tests.faults.pty_rig import running
from tests.faults.rig import Rig, Unit, make_rig, read

POLL = PollSettings(live_s=1.0, settings_s=10.0)
FIRSTS = (0x0000, 0x000A, 0x0014, 0xE000, 0x8000)
COUNTS = (2, 4, 10)
WRITE = bytes.fromhex("06 E000 1234")


def storm(chaos: Chaos, reads: int, retries: int = 2) -> Rig:
    """Three units, polled and read by three clients in few shapes, so that a late reply fits many a question."""
    rig = make_rig(Unit(0), Unit(1), Unit(2), medium=chaos, opened_s=0.1, poll=POLL, retries=retries)
    rng = Random(chaos.seed)
    for n in range(reads):
        pdu = read(rng.choice(FIRSTS), rng.choice(COUNTS), rng.choice((3, 3, 3, 4, 1, 2)))
        if pdu[0] < 3:
            pdu = read(rng.randrange(100), 64, pdu[0])
        if rng.random() < 0.02:
            pdu = read_identification_request()
        rig.read(rng.randrange(3), pdu, client=f"client-{n % 3}")
        rig.run(0.5 * rng.random())
    rig.run(10.0)
    rig.account()
    return rig


@pytest.mark.parametrize("rate", [0.003, 0.02, 0.1])
@pytest.mark.parametrize("seed", range(6))
def test_under_all_faults_at_once(seed: int, rate: float) -> None:
    rig = storm(Chaos(seed, all_at(rate, but=frozenset())), 250)
    assert sum(rig.outcomes.values()) == 250


@pytest.mark.parametrize("fault", sorted(LINE_FAULTS))
def test_under_one_kind_of_fault(fault: Fault) -> None:
    rate = 0.04 if fault in {Fault.LATE, Fault.SILENCE} else 0.15  # these cost seconds each
    storms = [storm(Chaos(seed, {fault: rate}), 150) for seed in range(1, 5)]
    assert [sum(rig.outcomes.values()) for rig in storms] == [150] * 4
    # How much one storm brings depends on whose turn it was when a fault fell; four together show that it was one.
    assert sum(rig.outcomes["reply"] for rig in storms) > 100
    assert sum(rig.chaos.counts[fault] for rig in storms) > 20


@given(
    seed=st.integers(0, 2**32),
    rates=st.dictionaries(st.sampled_from(sorted(Fault)), st.sampled_from((0.01, 0.1, 0.5)), max_size=6),
    late_s=st.sampled_from((0.5, 0.7, 1.5, 6.0)),
    retries=st.integers(0, 3),
)
def test_under_any_mixture(seed: int, rates: dict[Fault, float], late_s: float, retries: int) -> None:
    spans = Spans(late_s=(0.3, late_s), silence_s=(0.1, 3.0))
    storm(Chaos(seed, rates, spans=spans), 25, retries=retries)


def wrong_value(seed: int) -> AssertionError | None:
    """The first wrong value under late and lost replies, or None."""
    try:
        storm(Chaos(seed, {Fault.LATE: 0.05, Fault.DROP: 0.05}), 300)
    except AssertionError as error:
        return error
    return None


def test_without_the_settling_question_late_replies_are_taken_for_others(monkeypatch: pytest.MonkeyPatch) -> None:
    """What the rule is for, and that these tests would see it missing.

    About one storm in five meets what the rule is against; which one depends on whose turn it was. So they are
    searched for without the rule, and the same storms are harmless with it.
    """
    harmful: dict[int, AssertionError] = {}
    with monkeypatch.context() as without:
        without.setattr(Doubt, "allows", lambda _self, _function: True)
        for seed in range(100):
            error = wrong_value(seed)
            if error is not None:
                harmful[seed] = error
            if len(harmful) == 4:
                break
    assert len(harmful) == 4
    for seed, error in harmful.items():
        assert str(error).startswith(("late", "foreign", "torn"))
        assert f"chaos seed={seed} " in error.__notes__[0]
    assert [wrong_value(seed) for seed in harmful] == [None] * 4


def test_a_write_that_succeeded_was_made_and_none_is_made_twice() -> None:
    """Always the same write, so that a late answer to one fits the next."""
    kinds = dict.fromkeys(LINE_FAULTS - {Fault.ECHO, Fault.SILENCE}, 0.03)
    succeeded = 0
    for seed in range(8):
        rig = make_rig(Unit(0), medium=Chaos(seed, kinds), poll=POLL, writes=True)
        made = rig.units[0].writes
        for _ in range(100):
            before = len(made)
            outcome = rig.write(0, WRITE)
            assert len(made) - before <= 1, rig.chaos.report()
            if outcome == WRITE:
                succeeded += 1
                assert len(made) == before + 1, rig.chaos.report()
            rig.run(0.3)
        rig.account()
    assert succeeded > 100


async def test_over_a_pty(tmp_path: Path) -> None:
    # The pty hands bytes over in batches, as adapters do: behind them a second copy would meet the next request.
    kinds = dict.fromkeys(LINE_FAULTS - {Fault.SILENCE, Fault.DUPLICATE}, 0.04)
    chaos = Chaos(77, kinds, spans=Spans(delay_s=(0.005, 0.05), late_s=(0.1, 0.6)))
    rng = Random(77)
    async with running(
        tmp_path, Unit(0), Unit(1), medium=chaos, reply_timeout_s=0.1, poll=PollSettings(live_s=1.0, settings_s=5.0)
    ) as line:
        await line.until(lambda: line.up)
        replies = 0
        for _ in range(30):
            outcome = await line.ask(rng.randrange(2), read(rng.choice(FIRSTS), rng.choice(COUNTS)))
            replies += isinstance(outcome, bytes)
            line.judge_snapshots()
        assert replies > 5
