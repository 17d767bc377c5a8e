"""F35: what a flood may send to the line leaves the polls on time, in virtual time."""

from __future__ import annotations

from itertools import pairwise

import pytest

from gateway.core.ratelimit import Bucket, ClientRate, LineLimiter, LineRates
from gateway.modbus.pdu import Function, ReadRequest
from tests.core.test_engine import Registers
from tests.core.virtual_line import VirtualLine, make_line
from tests.faults.tcp.virtual import VirtualPort

LIVE_BLOCK = 82
BURST_S = 2.0
TURN_S = 0.3  # the transaction that is on the wire then


def longest_period_s(line: VirtualLine) -> float:
    """The longest time between two polls of the live values of one device."""
    sent = [at for at, frame in line.sent if frame[0] == 1 and frame[5] == LIVE_BLOCK]
    return max(later - earlier for earlier, later in pairwise(sent))


@pytest.mark.parametrize("clients", [1, 4])
def test_polls_keep_their_period(clients: int) -> None:
    line = make_line(Registers(1), Registers(2))
    for device in line.devices:
        device.line = VirtualPort(line)
    line.run(30.0)
    line.sent.clear()
    line.run(60.0)
    baseline_s = longest_period_s(line)
    line.sent.clear()
    limiter = LineLimiter(LineRates(), BURST_S, line.devices)
    buckets = [Bucket(ClientRate().line_per_s, BURST_S, line.now) for _ in range(clients)]
    asked = answered = 0

    def done(_: object) -> None:
        nonlocal answered
        answered += 1

    for _ in range(3000):  # a minute of 500 reads a second and client, none of which is in memory
        for client, bucket in enumerate(buckets):
            for _ in range(10):
                device = line.devices[asked % 2]
                if limiter.take(bucket, device, line.now) is None:
                    pdu = ReadRequest(Function.READ_HOLDING_REGISTERS, 0x1000 + 7 * (asked % 997), 1).encode()
                    line.read(device, pdu, done, client=f"client-{client}")
                    asked += 1
        line.run(0.02)
    assert asked > 1000
    # A poll that is due waits for one read of a client at most (core/scheduler.py).
    assert longest_period_s(line) < baseline_s + TURN_S
    line.run(20.0)
    assert answered == asked, "each has an end"
