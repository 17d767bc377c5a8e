"""An upstream engine, oracle controllers behind a simulated server, and chaos between them; every reply is judged.

As tests/faults/rig.py for serial lines: whatever comes out of the engine goes to the oracle at once, and any verdict
but "right" fails the test with its seed.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from random import Random
from typing import Any

from gateway.core.requests import Lane
from gateway.core.settings import PollSettings
from gateway.core.site import Device, Outcome
from gateway.errors import RequestError
from gateway.modbus.pdu import is_exception
from gateway.modbus.rtu import Timing
from gateway.simulator.oracle import Verdict
from gateway.simulator.tcp_chaos import EXCEPTIONS, TcpChaos
from gateway.simulator.upstream import Habits, SimulatedServer
from tests.core.virtual_upstream import VirtualUpstream, make_upstream
from tests.faults.judge import Judge
from tests.faults.rig import Unit, oracle_map, read

POLL = PollSettings(live_s=1.0, settings_s=10.0)
BUS = Timing.of(115200, 8, "N", 1)
FIRSTS = (0x0000, 0x000A, 0x0014, 0xE000, 0x8000)
COUNTS = (2, 4, 10)


class UpstreamRig:
    """See the module."""

    def __init__(self, units: Sequence[Unit], chaos: TcpChaos, habits: Habits, **settings: Any) -> None:
        self.units = list(units)
        self.chaos = chaos
        self.server = SimulatedServer(units, habits=habits, bus=BUS, spoiler=chaos)
        devices = [Device(f"array-{n}", 10 + n, unit.address, oracle_map()) for n, unit in enumerate(units, 1)]
        settings.setdefault("poll", POLL)
        self.connections: int = settings.get("connections", 1)
        self.line: VirtualUpstream = make_upstream(self.server, devices, **settings)
        judge = Judge(self.units, devices, self._count)
        self.line.after_step = judge.blocks
        self._judge_values = judge.values
        self.devices = devices
        self.verdicts: Counter[Verdict] = Counter()
        self.outcomes: Counter[str] = Counter()

    def read(self, unit: int, pdu: bytes, client: str = "", done: Callable[[Outcome], None] | None = None) -> None:
        """Read as a client does; the outcome is judged."""
        asked_at = self.line.now

        def judged(outcome: Outcome) -> None:
            if isinstance(outcome, RequestError):
                self.outcomes[outcome.label] += 1
            elif is_exception(outcome) and outcome[1] in EXCEPTIONS.values():
                self.outcomes["exception"] += 1
            else:
                self.outcomes["reply"] += 1
                self._count(self.units[unit].judge_reply(pdu, outcome, asked_at=asked_at), f"{pdu.hex()} of {unit}")
            if done is not None:
                done(outcome)

        self.line.engine.read(self.devices[unit], pdu, judged, self.line.now, client=client, lane=Lane.CLIENT)

    def wrong(self) -> list[str]:
        """Verdicts that are not right."""
        return [verdict for verdict in self.verdicts if verdict is not Verdict.RIGHT]

    def account(self) -> None:
        """Every transaction is accounted for, and nothing that is shown is wrong."""
        stats = self.line.engine.stats
        assert 0 <= stats.sent - stats.ok - stats.failed.total() <= 8 * self.connections, stats
        assert set(stats.failed) <= {"timeout", "mismatch", "exception", "connection_lost", "line_down"}, stats.failed
        assert self.server.counters.most_open <= self.connections
        self._judge_values()

    def _count(self, verdict: Verdict, what: str) -> None:
        self.verdicts[verdict] += 1
        assert verdict is Verdict.RIGHT, f"{verdict} at {self.line.now:.4f}: {what}; seed {self.chaos.seed}"


def storm(chaos: TcpChaos, reads: int, habits: Habits | None = None, **settings: Any) -> UpstreamRig:
    """Three units, polled and read by three clients in few shapes, often many at once."""
    settings.setdefault("reply_timeout_s", 0.5)
    rig = UpstreamRig([Unit(0), Unit(1), Unit(2)], chaos, habits or Habits(latency_s=0.02), **settings)
    rng = Random(chaos.seed)
    rig.line.run(0.5)
    for n in range(reads):
        pdu = read(rng.choice(FIRSTS), rng.choice(COUNTS), rng.choice((3, 3, 3, 4)))
        if rng.random() < 0.1:
            pdu = read(rng.randrange(100), 64, 1)
        rig.read(rng.randrange(3), pdu, client=f"client-{n % 3}")
        if rng.random() < 0.4:
            rig.line.run(0.5 * rng.random())
    rig.line.run(20.0)
    rig.account()
    return rig
