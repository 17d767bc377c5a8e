"""F67: 500 idle or half-sent HTTP connections: at most 16 are kept, and a scrape takes less than 100 ms meanwhile.

By TLS as many more may be shaking hands.
"""

from __future__ import annotations

import re
import socket
import ssl
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

from tests.e2e.programs import Launch, wait_until
from tests.faces.http.test_access import certificate
from tests.machine import Bystander

STRANGERS = 500
KEPT = 16
SENDS = (
    b"",
    b"GET /metrics HTTP/1.1\r\nHost: gateway\r\nX-Slow: ",
    b"POST / HTTP/1.1\r\nHost: gateway\r\nContent-Length: 9\r\n\r\n",
)
"""Nothing, half a header, half a body: each by every third of them."""

HELLO = bytes.fromhex("16 0301 0200 01 0001fc 0303")
"""The beginning of a ClientHello of 512 bytes."""

HEADER_S = 5.0
SCRAPE_S = 0.1


@contextmanager
def strangers(port: int, trusted: ssl.SSLContext | None) -> Iterator[list[socket.socket]]:
    """Connections that send that much and wait; by TLS, every other one of them before its handshake is over."""
    with ExitStack() as stack:
        opened = []
        for number in range(STRANGERS):
            stranger = stack.enter_context(socket.create_connection(("127.0.0.1", port), timeout=60))
            sends = SENDS[number % len(SENDS)]
            if trusted is not None and number % 2:
                stranger = stack.enter_context(trusted.wrap_socket(stranger, server_hostname="127.0.0.1"))
            elif trusted is not None:
                sends = sends and HELLO
            opened.append(stranger)
            stranger.sendall(sends)
            stranger.setblocking(False)
        yield opened


def is_open(stranger: socket.socket) -> bool:
    """Whether the gateway has not ended it."""
    try:
        return stranger.recv(65536) != b""
    except (BlockingIOError, ssl.SSLWantReadError):
        return True
    except (ConnectionError, ssl.SSLError):
        return False


def descriptors(text: str) -> int:
    """How many the gateway had open when it was scraped."""
    [found] = re.findall(r"^process_open_fds (\S+)$", text, re.MULTILINE)
    return int(float(found))


@pytest.mark.parametrize("secure", [False, True], ids=["http", "https"])
def test_a_scrape_is_quick_and_few_are_kept(
    launch: Launch, tmp_path: Path, passing: Bystander, *, secure: bool
) -> None:
    trusted, keys, kept = None, "", KEPT
    if secure:
        crt, key = certificate(tmp_path)
        trusted = ssl.create_default_context(cafile=crt)
        trusted.check_hostname = False
        keys, kept = f'tls_certificate = "{crt}"\ntls_private_key = "{key}"', 2 * KEPT
    site = launch(http_keys=keys, trusted=trusted)
    site.wait_online()
    usual = descriptors(site.get("/metrics")[1])
    with strangers(site.http, trusted) as opened:
        passing.start()
        taken: list[float] = []
        while len(taken) < 5 or (min(taken) >= SCRAPE_S and len(taken) < 50):  # of a busy machine its best
            asked = time.monotonic()
            status, text = site.get("/metrics")
            taken.append(time.monotonic() - asked)
            assert status == 200
            assert "morningstar_battery_voltage_volts" in text
            assert descriptors(text) <= usual + kept  # the scrape's own among both
        assert min(taken) < SCRAPE_S
        wait_until(lambda: sum(map(is_open, opened)) <= kept, f"{kept} of {STRANGERS} connections at most")
        wait_until(lambda: not any(map(is_open, opened)), "the end of the last of them")
        assert passing.stop() < 3 * HEADER_S, "its time, and a busy machine"
    assert site.get("/healthz")[0] == 200
