"""F43: a write that times out is never repeated: 0B, "unknown" until it was read back, what was known is forgotten."""

from __future__ import annotations

from pathlib import Path

import pytest

from gateway.core.write_ledger import Fate
from gateway.faces.modbus import writer
from tests.faces.modbus.writing import writing


@pytest.mark.parametrize(("swallowed", "settled"), [(0, Fate.WRITTEN), (1, Fate.NOT_WRITTEN)])
async def test_it_is_sent_once_and_settled_by_reading_back(
    tmp_path: Path, swallowed: int, settled: Fate, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(writer, "SETTLE_S", 0.05)
    async with writing(tmp_path) as it:
        it.poll()
        it.line.lost.update(write=1, read=1)
        it.line.swallowed = swallowed
        assert await it.query("05 0001 ff00") == "850b"
        await it.until(lambda: it.fates() == [Fate.UNKNOWN])
        assert it.stats.writes == {"unknown": 1}
        await it.until(lambda: it.fates() == [settled])
        assert it.line.writes == [bytes.fromhex("050001ff00")]


async def test_what_clients_had_read_is_not_served_any_more(tmp_path: Path) -> None:
    async with writing(tmp_path) as it:
        before = await it.query("03 e000 0002")
        assert await it.query("03 e000 0002") == before
        assert len(it.line.sent) == 1
        it.line.lost["write"] = 1
        assert await it.query("06 e000 4b64") == "860b"
        assert await it.query("03 e000 0002") == f"03044b64{before[8:]}"
        assert len(it.line.writes) == 1


async def test_the_rest_of_the_request_is_not_sent(tmp_path: Path) -> None:
    async with writing(tmp_path) as it:
        it.line.lost["write"] = 1
        assert await it.query("10 e000 0003 06 4b64 4b10 2328") == "900b"
        assert it.line.writes == [bytes.fromhex("06e0004b64")]
        await it.until(lambda: it.fates()[1:] == [Fate.NOT_SENT, Fate.NOT_SENT])


async def test_one_that_a_restart_interrupted_is_settled_by_the_next_run(tmp_path: Path) -> None:
    async with writing(tmp_path) as it:
        line = it.line
        it.poll()
        line.held = True
        it.ask("05 0001 ff00")
        await it.until(lambda: line.waiting)
        line.waiting.clear()  # killed: nobody is told how it ended
        assert it.fates() == [None]
    async with writing(tmp_path, line=line) as it:
        assert await it.query("05 0002 ff00") == "050002ff00"
        await it.until(lambda: it.fates() == [Fate.NOT_WRITTEN, Fate.WRITTEN])
