"""F68: a scrape during a slow serial read is answered from the snapshots and never touches the line."""

from __future__ import annotations

import re
import socket
import struct

from tests.e2e.programs import Launch, Running

DAILY_LOG = 0x8000
WORDS = 125  # about 0.3 s at 9600 baud


def client_reads(site: Running) -> float:
    """Requests that the line made for clients until now."""
    text = site.get("/metrics")[1]
    return sum(
        float(n) for n in re.findall(r"^prostar_gateway_line_client_reads_total\{.*\} (\S+)$", text, re.MULTILINE)
    )


def test_scrapes_do_not_wait_for_the_line_and_ask_nothing_of_it(launch: Launch) -> None:
    site = launch(rest="[history]\nenabled = false\n")
    site.wait_online()
    before = client_reads(site)
    block = most = 0
    while most < 3 and block < 16:  # of a busy machine its best
        scrapes = 0
        with socket.create_connection(("127.0.0.1", site.modbus), timeout=60) as client:
            client.sendall(struct.pack(">HHHBBHH", 1, 0, 6, 11, 3, DAILY_LOG + block * WORDS, WORDS))
            client.setblocking(False)
            reply = b""
            while not reply:
                try:
                    reply = client.recv(300)
                except BlockingIOError:
                    status, text = site.get("/metrics")
                    assert status == 200
                    assert len(re.findall("^morningstar_battery_voltage_volts{", text, re.MULTILINE)) == 3
                    scrapes += 1
            assert len(reply) == 9 + 2 * WORDS
        block, most = block + 1, max(most, scrapes)
    assert most >= 3, "the first scrape waited for the read, so that no other was made before its reply"
    assert client_reads(site) == before + block
