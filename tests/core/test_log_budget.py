"""A log that nobody can fill."""

from __future__ import annotations

from gateway.core.log_budget import LogBudget


def test_one_line_a_kind_and_window() -> None:
    budget = LogBudget(window_s=60, lines=10)
    assert budget.spend("a", 0.0) == 0
    assert budget.spend("a", 59.9) is None
    assert budget.spend("b", 59.9) == 1
    assert budget.spend("a", 60.0) == 0


def test_no_more_lines_than_allowed_however_many_kinds() -> None:
    budget = LogBudget(window_s=60, lines=10)
    told = [kind for kind in range(65_536) if budget.spend(kind, 1.0) is not None]
    assert told == list(range(10))
    assert budget.spend("later", 61.0) == 65_526
