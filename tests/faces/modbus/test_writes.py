"""Writing through the face: order, many clients, the cache, the ledger's failures, restarts."""

from __future__ import annotations

import errno
import logging
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from gateway.core.snapshot import DeviceState
from gateway.core.write_ledger import Fate
from gateway.faces.modbus import ledger, writer
from gateway.faces.modbus.ledger import NAME
from tests.faces.modbus.writing import ControllerLine, writing

VOLTAGE = "06 e000 4b64"


@contextmanager
def full_disk(monkeypatch: pytest.MonkeyPatch, *, after: int) -> Iterator[None]:
    """The ledger's file takes `after` bytes more, then there is no space."""

    def write_all(fd: int, data: bytes) -> None:
        os.write(fd, data[:after])
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(ledger, "_write_all", write_all)
        yield


async def test_a_write_that_is_allowed_is_done_noted_and_logged(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    async with writing(tmp_path) as it:
        old = it.holds(0xE000)
        assert await it.query(VOLTAGE) == "06e0004b64"
        await it.until(lambda: it.fates() == [Fate.WRITTEN])
        (entry,) = it.ledger()
        assert (entry.intent.peer, entry.intent.old, entry.intent.new) == ("127.0.0.1", old, 0x4B64)
        assert it.stats.writes == {"written": 1}
        assert it.line.clients == {"127.0.0.1"}
        (line,) = [text for text in caplog.messages if text.startswith("event=write ")]
        assert line.endswith(f"registers=0xE000 old=0x{old:04X} new=0x4B64 outcome=written left_out=0")


async def test_the_intent_is_on_the_disk_before_the_bytes_go_out(tmp_path: Path) -> None:
    async with writing(tmp_path) as it:
        it.line.held = True
        it.ask("05 0001 ff00")
        await it.until(lambda: it.line.waiting)
        assert [list(line)[0] for line in it.lines()] == ["intended"]  # noqa: RUF015 - the first key names the kind
        it.line.release()
        assert await it.answer() == "050001ff00"
        await it.until(lambda: it.fates() == [Fate.WRITTEN])


async def test_several_are_done_one_by_one(tmp_path: Path) -> None:
    async with writing(tmp_path) as it:
        assert await it.query("10 e002 0002 04 2328 1388") == "10e0020002"
        assert it.line.writes == [bytes.fromhex("06e0022328"), bytes.fromhex("06e0031388")]
        assert await it.query("0f 0000 0003 01 06") == "0f00000003"
        assert it.line.writes[2:] == [bytes.fromhex(f"05000{at}{'ff00' if at else '0000'}") for at in range(3)]


async def test_the_exception_of_a_part_answers_the_request(tmp_path: Path) -> None:
    async with writing(tmp_path) as it:
        it.line.lost["write"] = 1
        assert await it.query("10 e002 0002 04 2328 1388") == "900b"
        await it.until(lambda: it.fates() == [Fate.WRITTEN, Fate.NOT_SENT])  # once it was read back
        assert len(it.line.writes) == 1
        assert it.stats.exceptions == {0x0B: 1}


async def test_what_clients_had_read_of_a_register_is_forgotten(tmp_path: Path) -> None:
    async with writing(tmp_path) as it:
        before = await it.query("03 e000 0002")
        assert await it.query("03 e000 0002") == before
        assert len(it.line.sent) == 1, "from memory"
        await it.query(VOLTAGE)
        assert await it.query("03 e000 0002") == f"03044b64{before[8:]}"


async def test_writes_of_a_device_go_one_after_another_and_of_others_at_once(tmp_path: Path) -> None:
    async with writing(tmp_path) as it:
        it.line.held = True
        second = await it.connect()
        it.ask("06 e000 4b64")
        await it.until(lambda: it.line.waiting)
        it.ask("06 e001 4b10", client=second)
        it.ask("03 0000 0001", unit=12, client=await it.connect())
        await it.until(lambda: len(it.line.waiting) == 2)
        assert [ticket.pdu[:3].hex() for ticket in it.line.waiting] == ["03e000", "030000"], "the second write waits"
        it.line.held = False
        it.line.release()
        assert await it.answer() == "06e0004b64"
        assert await it.answer(second) == "06e0014b10"


async def test_slave_control_waits_for_no_other_write(tmp_path: Path) -> None:
    async with writing(tmp_path, interval_s=3600.0) as it:
        it.line.held = True
        second = await it.connect()
        it.ask(VOLTAGE)
        await it.until(lambda: it.line.waiting)
        for value in ("4b00", "4b01", "4b01"):
            it.ask(f"06 0025 {value}", client=second)
            await it.until(lambda: len(it.line.waiting) > 1)
            ticket = it.line.waiting.pop()
            assert ticket.write
            assert ticket.done is not None
            ticket.done(ticket.pdu)
            assert await it.answer(second) == f"060025{value}"


async def test_more_than_the_queue_holds_is_06(tmp_path: Path) -> None:
    async with writing(tmp_path) as it:
        it.line.held = True
        clients = [await it.connect() for _ in range(writer.QUEUE_LIMIT + 1)]
        it.ask(VOLTAGE)
        await it.until(lambda: it.line.waiting)
        for client in clients[:-1]:
            it.ask("05 0001 ff00", client=client)
        waiting = it.server.writer._waiting[11]  # type: ignore[union-attr]  # the writer is there where writes are on
        await it.until(lambda: len(waiting) == writer.QUEUE_LIMIT)
        assert await it.query("05 0001 ff00", client=clients[-1]) == "8506"
        it.ask("06 0025 4b00", client=clients[-1])
        await it.until(lambda: len(it.line.waiting) == 2)  # slave control needs no place
        it.line.held = False
        it.line.release()
        assert await it.answer(clients[-1]) == "0600254b00"


async def test_a_write_under_way_goes_on_without_its_client_and_one_that_waits_does_not(tmp_path: Path) -> None:
    async with writing(tmp_path) as it:
        it.line.held = True
        gone = await it.connect()
        it.ask(VOLTAGE, client=gone)
        await it.until(lambda: it.line.waiting)
        it.ask("06 e001 4b10", client=gone)
        third = await it.connect()
        it.ask("06 e002 0010", client=third)
        writes = it.server.writer._waiting[11]  # type: ignore[union-attr]  # as above
        await it.until(lambda: len(writes) == 2)
        it.reset(gone)
        await it.until(lambda: sum(order.done is None for order in writes) == 1)
        it.line.held = False
        it.line.release()
        assert await it.answer(third) == "06e0020010"
        await it.until(lambda: it.fates() == [Fate.WRITTEN, Fate.WRITTEN])
        assert [pdu[1:3].hex() for pdu in it.line.writes] == ["e000", "e002"]


async def test_only_who_may_write_gets_to_know_more(tmp_path: Path) -> None:
    async with writing(tmp_path) as it:
        assert await it.query(VOLTAGE, unit=12) == "8601"
        assert await it.query("06 e0", unit=12) == "8601", "whatever its form"
        assert await it.query("06 e0") == "8603"
        assert await it.query("16 e000 00ff 0000") == "9601"
        assert await it.query("05 00fe ff00") == "8501", "factory reset was not named"
        assert await it.query("05 0020 ff00") == "8501", "the lighting test is read only"
        assert await it.query("06 e000 7e00") == "8603"
        assert await it.query("10 e038 0002 04 4000 4000") == "9001", "partly inside"
        assert await it.query("05 00ff ff00") == "0500ffff00"
        assert it.line.writes == [bytes.fromhex("0500ffff00")]
        assert it.stats.refused == {"no_write_rule": 2, "write_function": 1, "write_not_allowed": 3, "write_value": 1}


async def test_without_a_ledger_writes_are_refused_and_reads_go_on(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("no folder")
    async with writing(blocked) as it:
        for _ in range(3):
            assert await it.query(VOLTAGE) == "8604"
        assert (await it.query("03 e000 0001"))[:4] == "0302"
        assert not it.line.writes
        assert it.stats.refused == {"ledger_unavailable": 3}
        assert sum("event=write_ledger_failed" in text for text in caplog.messages) == 1
        assert await it.query("06 0025 4b00") == "0600254b00", "slave control must not stop"
        blocked.unlink()
        assert await it.query(VOLTAGE) == "06e0004b64"
        assert sum("event=write_ledger_works_again" in text for text in caplog.messages) == 1
        await it.until(lambda: it.fates() == [Fate.WRITTEN, Fate.WRITTEN])
        assert it.ledger()[0].intent.point == "battery_target_voltage_slave", "noted as soon as it could be"


async def test_a_full_disk_refuses_writes_until_it_has_room(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    async with writing(tmp_path) as it:
        assert await it.query(VOLTAGE) == "06e0004b64"
        await it.until(lambda: it.fates() == [Fate.WRITTEN])
        before = (tmp_path / NAME).read_bytes()
        with full_disk(monkeypatch, after=20):
            assert await it.query("06 e001 4b10") == "8604"
            assert (await it.query("03 e001 0001"))[:4] == "0302"
        assert (tmp_path / NAME).read_bytes() == before, "no half line is left behind"
        assert await it.query("06 e001 4b10") == "06e0014b10"
        await it.until(lambda: it.fates() == [Fate.WRITTEN, Fate.WRITTEN])


async def test_an_outcome_that_could_not_be_noted_follows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    async with writing(tmp_path) as it:
        it.line.held = True
        it.ask("05 0001 ff00")
        await it.until(lambda: it.line.waiting)
        with full_disk(monkeypatch, after=0):
            it.line.release()
            assert await it.answer() == "050001ff00"
            assert it.fates() == [None]
        it.line.held = False
        assert await it.query("05 0002 ff00") == "050002ff00"
        await it.until(lambda: it.fates() == [Fate.WRITTEN, Fate.WRITTEN])


async def test_what_the_last_run_left_open_is_settled_when_the_device_is_there(tmp_path: Path) -> None:
    line = ControllerLine()
    async with writing(tmp_path, line=line) as it:
        line.lost.update(write=1, read=99)
        assert await it.query("05 0001 ff00") == "850b"
        await it.until(lambda: it.fates() == [Fate.UNKNOWN])
    line.lost.clear()
    async with writing(tmp_path, line=line) as it:
        assert await it.query("05 0002 ff00") == "050002ff00"
        await it.until(lambda: it.fates() == [Fate.WRITTEN, Fate.WRITTEN])
        assert it.line.sent[-2:] == [bytes.fromhex("0100010001"), bytes.fromhex("050002ff00")], "read back first"


async def test_what_nobody_knows_is_read_back_by_itself(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(writer, "SETTLE_S", 0.01)
    async with writing(tmp_path) as it:
        it.line.lost["write"] = 1
        it.line.swallowed = 1
        assert await it.query(VOLTAGE) == "860b"
        await it.until(lambda: it.fates() == [Fate.NOT_WRITTEN])
        assert len(it.line.writes) == 1
        it.device.snapshot = type(it.device.snapshot)(state=DeviceState.STALE)
        assert not it.server.writer._unsettled  # type: ignore[union-attr]  # as above


async def test_a_mistake_in_a_procedure_ends_that_write_only(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    async with writing(tmp_path) as it:
        with monkeypatch.context() as patch:
            patch.setattr(writer, "perform", _broken)
            assert await it.query(VOLTAGE) == "8604"
        assert "event=write_failed device=array-1" in caplog.text
        assert await it.query(VOLTAGE) == "06e0004b64"


def _broken(*_: object) -> Iterator[None]:
    yield from (None for _ in range(1 // 0))
