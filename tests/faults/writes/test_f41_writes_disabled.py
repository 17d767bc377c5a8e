"""F41: a write when writes are disabled (the default) is 01, with a line that says who and where, not the value."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.faces.modbus.writing import writing

REQUESTS = {
    "05 0001 ff00": "8501",
    "06 e000 4b64": "8601",
    "0f 0000 0002 01 03": "8f01",
    "10 e000 0001 02 4b64": "9001",
    "16 e000 00ff 0000": "9601",
    "17 0000 0001 e000 0001 02 4b64": "9701",
    "06 e0": "8601",
}


async def test_every_function_that_writes_is_refused_and_nothing_is_sent(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    async with writing(tmp_path, on=False) as it:
        for request, reply in REQUESTS.items():
            assert await it.query(request) == reply
        assert not it.line.sent
        assert it.stats.refused == {"writes_disabled": len(REQUESTS)}
        assert it.lines() == [], "no ledger either"
    lines = [text for text in caplog.messages if text.startswith("event=write_refused")]
    assert len(lines) == len(REQUESTS)
    for line in lines:
        assert line.startswith("event=write_refused peer=127.0.0.1 unit=11 function=0x")
        assert " address=" in line
        assert "4b64" not in line


async def test_a_peer_that_goes_on_for_ever_does_not_fill_the_log(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    async with writing(tmp_path, on=False) as it:
        for _ in range(50):
            assert await it.query("06 e000 4b64") == "8601"
        assert it.stats.refused == {"writes_disabled": 50}
    assert len(caplog.messages) == 1
