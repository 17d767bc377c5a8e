"""What the measurement prints of rounds that went as they should not."""

from __future__ import annotations

from tests.bench.bench_snmp import REFERENCE, Run, table


def a_run(cpu_us: float) -> Run:
    return Run(rate=1000.0, cells=1000.0, cpu_us=cpu_us, p50_us=1, p99_us=2, lost=0, wrong=0)


def test_a_round_in_which_the_reference_used_no_cpu_to_speak_of_has_no_ratio() -> None:
    shown = table({REFERENCE: [a_run(0.0), a_run(10.0)], "other": [a_run(20.0), a_run(30.0)]})
    other = shown.splitlines()[3].split(" | ")
    assert (other[2], other[4]) == ("1.00", "3.00")


def test_without_any_round_to_compare_with_there_is_none() -> None:
    shown = table({REFERENCE: [a_run(0.0)], "other": [a_run(20.0)]})
    other = shown.splitlines()[3].split(" | ")
    assert (other[2], other[4]) == ("–", "–")
