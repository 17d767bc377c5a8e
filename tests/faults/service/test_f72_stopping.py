"""F72: SIGTERM with clients, a transaction on the wire, reads that wait, half-open connections of every kind."""

from __future__ import annotations

import asyncio
import contextlib
import os
import re
import signal
import socket
import struct
from collections.abc import Callable

import pytest

from gateway.core.write_ledger import Fate, entries
from gateway.devices.schema import load_map
from gateway.faces.modbus.ledger import read_ledger
from gateway.service.settings import STOP_GRACE_S
from tests.faces.modbus.tls.conftest import pki
from tests.faces.modbus.tls.site import Pki
from tests.faults.service.rig import QUIET, Service, client, read
from tests.machine import Bystander

__all__ = ["pki"]


async def test_the_wire_is_waited_for_the_queue_is_06_and_nobody_new_gets_in(
    service: Service, passing: Bystander
) -> None:
    service.configure()
    program = service.start()
    await service.online()
    unit = service.units["shelter-a"][0]
    await unit.is_quiet()
    unit.turnaround_s = 2.0
    async with client(service.modbus) as on_the_wire, client(service.modbus) as waits, client(service.modbus) as idle:
        on_the_wire.ask(11, read(0xE000, 2))
        await unit.is_asked(read(0xE000, 2))
        waits.ask(11, read(0x0000, 8, function=1))  # what was polled is older than max_age_s
        waits.ask(11, read(0xE010, 2))
        assert await idle.read(99) == b"\x83\x0a"  # so what came before it is known
        passing.start()
        program.process.terminate()
        assert await waits.reply() == b"\x81\x06"
        assert await waits.reply() == b"\x83\x06"
        with pytest.raises(TimeoutError):  # they did not wait for it
            await on_the_wire.reply(timeout_s=0.01)
        assert await waits.reply() == b""
        assert await idle.reply() == b""
        with pytest.raises(OSError):
            await asyncio.open_connection("127.0.0.1", service.modbus)
        expected = b"\x03\x04" + b"".join(unit.word(at).to_bytes(2) for at in (0xE000, 0xE001))
        assert await on_the_wire.reply() == expected
        assert await on_the_wire.reply() == b""
    assert await service.ended() == 0
    assert passing.stop() < 10.0
    stopping = program.log().partition("event=stopping")[2]
    assert "event=device_stale" in stopping
    assert not re.search("level=(warning|error|critical)|Traceback", stopping)  # it is what was asked for


RULE = '[[modbus.write]]\nsource = ["127.0.0.1"]\npoint = ["float_voltage"]\n'
VOLTAGE = load_map("prostar-mppt").point("float_voltage").address
WRITE = b"\x06" + VOLTAGE.to_bytes(2) + b"\x4a\x00"


@pytest.mark.parametrize("stays", [True, False], ids=["its client waits", "its client has left"])
async def test_a_write_on_the_wire_is_waited_for_and_never_called_busy(service: Service, stays: bool) -> None:
    """It cannot be read back any more, so nobody knows; 06 would say that nothing was done."""
    service.configure(rest=QUIET + RULE, modbus_keys="writes = true")
    program = service.start()
    await service.online()
    unit = service.units["shelter-a"][0]
    await unit.is_quiet()
    unit.turnaround_s = 1.0
    async with client(service.modbus) as asker:
        asker.ask(11, WRITE)
        await unit.is_asked(WRITE)
        if stays:
            program.process.terminate()
            assert await asker.reply() == b"\x86\x0b"
            assert await asker.reply() == b""
        else:
            asker.reset()
    if not stays:
        program.process.terminate()
    assert await service.ended() == 0
    assert what_became_of_the_write(service) == (Fate.UNKNOWN, 0x0B)
    assert unit.asked.count(WRITE) == 1


async def test_a_write_that_is_given_up_was_sent_and_is_not_said_not_to_be(service: Service) -> None:
    service.configure(
        rest=QUIET + RULE, modbus_keys="writes = true", line_keys="baudrate = 115200\nreply_timeout_s = 10.0"
    )
    program = service.start()
    await service.online()
    unit = service.units["shelter-a"][0]
    await unit.is_quiet()
    async with client(service.modbus) as asker, client(service.modbus) as other, client(service.modbus) as third:
        unit.never_answered = WRITE
        asker.ask(11, WRITE)
        await unit.is_asked(WRITE)
        other.ask(11, WRITE)
        assert await third.read(99) == b"\x83\x0a"  # so the other write is known, and waits for the first
        program.process.terminate()
        assert await asker.reply() == b"\x86\x0b"
        assert await other.reply() == b"\x86\x06"
    assert await service.ended() == 0
    assert what_became_of_the_write(service) == (Fate.UNKNOWN, 0x0B)
    assert unit.asked.count(WRITE) == 1


def what_became_of_the_write(service: Service) -> tuple[Fate, int | None]:
    """As the ledger has it, to which the exception belongs."""
    (entry,) = entries(read_ledger(service.folder / "state"))
    assert entry.verdict is not None
    return entry.verdict.fate, entry.verdict.exception


async def test_a_controller_that_takes_for_ever_is_given_up_after_five_seconds(
    service: Service, passing: Bystander
) -> None:
    service.configure(line_keys="baudrate = 115200\nreply_timeout_s = 10.0")
    program = service.start()
    await service.online()
    unit = service.units["shelter-a"][0]
    await unit.is_quiet()
    unit.turnaround_s = 60.0
    async with client(service.modbus) as asker:
        asker.ask(11, read(0xE000, 2))
        await unit.is_asked(read(0xE000, 2))
        passing.start()
        program.process.terminate()
        assert await asker.reply() == b"\x83\x06"
        assert await asker.reply() == b""
    assert await service.ended() == 0
    assert passing.stop() < 10.0
    assert "Traceback" not in program.log()


async def test_a_client_that_reads_nothing_is_cut_off(service: Service, passing: Bystander) -> None:
    """What it was told already fills every buffer on the way, so that its connection cannot be closed in order."""
    service.configure(rest="[poll]\nlive_s = 0.2\n")
    program = service.start()
    await service.online()
    with socket.socket() as deaf:
        deaf.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2048)
        deaf.connect(("127.0.0.1", service.modbus))
        deaf.setblocking(False)
        asked = b"".join(struct.pack(">HHHB", tid, 0, 6, 11) + read(0, 80) for tid in range(500))
        sent = 0
        with contextlib.suppress(BlockingIOError):
            while sent < 1 << 26:  # until nothing more is taken: the gateway reads no more from who reads nothing
                sent += deaf.send(asked)
                await asyncio.sleep(0.001)
        assert sent < 1 << 26
        async with client(service.modbus) as other:
            assert (await other.read(11))[:2] == b"\x03\x04"
            passing.start()
            program.process.terminate()
            assert await other.reply() == b""
        assert await service.ended() == 0  # the deaf one's socket is still open
    assert passing.stop() < 8.0
    assert "Traceback" not in program.log()


async def test_half_handshakes_and_half_requests_hold_up_nothing(
    service: Service, pki: Pki, free_tcp_port: Callable[[], int], passing: Bystander
) -> None:
    files = pki.files()
    tls_port = free_tcp_port()
    service.configure(
        rest=f"""{QUIET}[modbus.tls]
listen = ["127.0.0.1:{tls_port}"]
certificate_file = "{files.certificate}"
key_file = "{files.key}"
client_ca_file = "{files.client_ca}"
"""
    )
    program = service.start()
    await service.online()
    async with client(tls_port) as silent, client(tls_port) as half, client(service.modbus) as frame:
        half.send(b"\x16\x03\x01\x02\x00\x01")  # the beginning of a ClientHello
        frame.send(b"\x00\x01\x00\x00\x00")
        async with client(service.http) as scraper:
            scraper.send(b"GET /metrics HT")
            assert (await service.get("/healthz"))[0] == 200  # so what came before it was read
            passing.start()
            program.process.terminate()
            for one in (silent, half, frame, scraper):
                assert await one.reply() == b""
    assert await service.ended() == 0
    assert passing.stop() < STOP_GRACE_S
    assert "Traceback" not in program.log()


async def test_a_reload_whose_file_hangs_holds_up_nothing(service: Service, passing: Bystander) -> None:
    """The pipe is a file on a disk or a network that gives nothing."""
    service.configure()
    program = service.start()
    await service.online()
    service.config.unlink()
    os.mkfifo(service.config)
    program.process.send_signal(signal.SIGHUP)
    writing: int | None = None
    async with asyncio.timeout(60):
        while writing is None:
            with contextlib.suppress(OSError):  # nobody reads it yet
                writing = os.open(service.config, os.O_WRONLY | os.O_NONBLOCK)
            await asyncio.sleep(0.01)
    read_on = asyncio.get_running_loop().call_later(15.0, os.close, writing)
    passing.start()
    program.process.terminate()
    assert await service.ended() == 0
    assert passing.stop() < 12.0  # it did not wait for the file
    read_on.cancel()
    os.close(writing)
    assert "Traceback" not in program.log()
