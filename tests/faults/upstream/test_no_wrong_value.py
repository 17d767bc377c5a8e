"""No wrong value, whatever a Modbus TCP server sends: every kind of fault, judged by the oracle."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.core.snapshot import DeviceState
from gateway.simulator.tcp_chaos import TcpChaos, TcpFault
from gateway.simulator.upstream import Habits
from tests.faults.upstream.rig import storm

HABITS = {
    "keeps": Habits(latency_s=0.02),
    "closes": Habits(closes=True, latency_s=0.02),
    "one at a time": Habits(one_at_a_time=True, latency_s=0.02),
    "says nothing": Habits(silence=None, latency_s=0.02),
}


@pytest.mark.parametrize("rate", [0.005, 0.03])
@pytest.mark.parametrize("habits", HABITS)
@pytest.mark.parametrize("seed", range(3))
def test_under_all_faults_at_once(seed: int, habits: str, rate: float) -> None:
    rig = storm(TcpChaos(seed, dict.fromkeys(TcpFault, rate)), 120, HABITS[habits])
    assert sum(rig.outcomes.values()) == 120


@pytest.mark.parametrize("fault", sorted(TcpFault))
def test_under_one_kind_of_fault(fault: TcpFault) -> None:
    rig = storm(TcpChaos(1, {fault: 0.1}), 150)
    assert sum(rig.outcomes.values()) == 150
    assert rig.outcomes["reply"] > 75
    assert rig.chaos.counts[fault] > 10


@pytest.mark.parametrize("connections", [1, 4])
@pytest.mark.parametrize("habits", HABITS)
def test_it_recovers_alone(habits: str, connections: int) -> None:
    rig = storm(TcpChaos(7, dict.fromkeys(TcpFault, 0.05)), 60, HABITS[habits], connections=connections)
    rig.chaos.stop()
    rig.line.run(75.0)
    assert [device.snapshot.state for device in rig.devices] == [DeviceState.ONLINE] * 3
    rig.account()


@given(
    seed=st.integers(0, 2**32),
    rates=st.dictionaries(st.sampled_from(sorted(TcpFault)), st.sampled_from((0.01, 0.1, 0.5)), max_size=6),
    habits=st.sampled_from(sorted(HABITS)),
    retries=st.integers(0, 3),
    pipelining=st.sampled_from((1, 2, 8, 32)),
    connections=st.sampled_from((1, 2, 4)),
)
def test_under_any_mixture(
    *, seed: int, rates: dict[TcpFault, float], habits: str, retries: int, pipelining: int, connections: int
) -> None:
    chaos = TcpChaos(seed, rates)
    storm(chaos, 25, HABITS[habits], retries=retries, pipelining=pipelining, connections=connections)
