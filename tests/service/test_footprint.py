"""What a controller takes of memory, and that it does not take more and more.

What resident memory does is measured by tests/bench/bench_footprint.py and tests/soak; here objects are counted, which
is the same on every machine.
"""

from __future__ import annotations

import pytest

from gateway.faces.snmp import answers, reader
from tests.service.memory_rig import MOMENTS, Controllers, allocated, forget_numbers, snapshots, traced


async def test_what_was_asked_at_different_times_keeps_no_old_snapshot() -> None:
    before = snapshots()
    site = Controllers(2)
    columns = [column for column in site.agent.tree.columns if column.size]
    for moment, column in enumerate(columns):
        site.poll(moment)
        site.ask(reader.GET, column.name(column.size - 1))
        unit = site.serving[0]
        answer = unit.answer(bytes((3, 0, moment % 60, 0, 1)), site.clock.now)
        site.hot.keep(bytes((moment,)), unit.device, answer, b"")  # type: ignore[arg-type]  # what is polled is in memory
    assert snapshots() - before <= 2 * len(site.records)


async def test_memory_is_flat_once_everything_was_asked_for() -> None:
    forget_numbers()
    site = Controllers(2)
    with traced():
        for moment in range(2 * MOMENTS):
            await site.everything(moment)
        before = allocated()
        for moment in range(MOMENTS):
            await site.everything(moment + MOMENTS)
        grown = allocated() - before
    assert grown < 4096


async def test_a_controller_costs_little(monkeypatch: pytest.MonkeyPatch) -> None:
    """Everything that everybody keeps of it, once everything was asked for; not what is bounded for the whole site."""
    monkeypatch.setattr(answers, "MOST_ANSWERS", 0)
    await Controllers(MOMENTS).everything(0)  # what is kept for the process is there from here on
    taken = []
    for count in (MOMENTS, 4 * MOMENTS):  # each of them shows a moment, so no site sees other numbers
        with traced():
            site = Controllers(count)
            for moment in range(2):
                await site.everything(moment)
            taken.append(allocated())
            del site
    assert 10 < (taken[1] - taken[0]) / (3 * MOMENTS) / 1024 < 36
