"""F67: 500 idle or half-sent HTTP connections: at most 16 are kept, and a scrape takes less than 100 ms meanwhile."""

from __future__ import annotations

import socket
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

from tests.e2e.programs import Launch, wait_until

STRANGERS = 500
KEPT = 16
SENDS = (
    b"",
    b"GET /metrics HTTP/1.1\r\nHost: gateway\r\nX-Slow: ",
    b"POST / HTTP/1.1\r\nHost: gateway\r\nContent-Length: 9\r\n\r\n",
)
"""Nothing, half a header, half a body: each by every third of them."""

HEADER_S = 5.0
SCRAPE_S = 0.1


@contextmanager
def strangers(port: int) -> Iterator[list[socket.socket]]:
    """Connections that send that much and wait."""
    with ExitStack() as stack:
        opened = []
        for number in range(STRANGERS):
            stranger = stack.enter_context(socket.create_connection(("127.0.0.1", port), timeout=10))
            opened.append(stranger)
            stranger.sendall(SENDS[number % len(SENDS)])
            stranger.setblocking(False)
        yield opened


def is_open(stranger: socket.socket) -> bool:
    """Whether the gateway has not ended it."""
    try:
        return stranger.recv(65536) != b""
    except BlockingIOError:
        return True
    except ConnectionError:
        return False


def test_a_scrape_is_quick_and_few_are_kept(launch: Launch) -> None:
    site = launch()
    site.wait_online()
    began = time.monotonic()
    with strangers(site.http) as opened:
        taken: list[float] = []
        while len(taken) < 5 or (min(taken) >= SCRAPE_S and len(taken) < 50):  # of a busy machine its best
            asked = time.monotonic()
            status, text = site.get("/metrics")
            taken.append(time.monotonic() - asked)
            assert status == 200
            assert "morningstar_battery_voltage_volts" in text
        assert min(taken) < SCRAPE_S
        wait_until(lambda: sum(map(is_open, opened)) <= KEPT, f"{KEPT} of {STRANGERS} connections at most")
        wait_until(lambda: not any(map(is_open, opened)), "the end of the last of them")
        assert time.monotonic() - began < 10 * HEADER_S
    assert site.get("/healthz")[0] == 200
