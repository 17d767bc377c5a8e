"""The targets of the fuzzers and their corpora work; what fuzzing finds becomes a test of its own."""

from __future__ import annotations

from pathlib import Path
from random import Random

import pytest

from gateway.modbus import frames
from tests.fuzz.corpus import write
from tests.fuzz.modbus_tcp import Target
from tests.fuzz.rtu import feed as play
from tests.fuzz.rtu import script
from tests.fuzz.snmp import agent, feed


async def test_the_targets_take_their_corpora(tmp_path: Path) -> None:
    write(tmp_path, 60)
    to = agent()
    datagrams = [path.read_bytes() for path in sorted((tmp_path / "snmp").iterdir())]
    for data in datagrams:
        feed(to, data)
    assert len(datagrams) > 50
    assert to.counters.dropped > 0
    streams = [path.read_bytes() for path in sorted((tmp_path / "modbus_tcp").iterdir())]
    assert len(streams) > 50
    target = Target()
    for data in streams:
        await target.feed(data[2:], [data[0], data[0] + data[1]])


def test_the_line_delivers_only_replies_to_what_it_asked() -> None:
    rng = Random(7)
    scripts = [script(rng) for _ in range(600)]
    scripts += [rng.randbytes(rng.randrange(400)) for _ in range(200)]
    assert sum(map(play, scripts)) > 300


@pytest.mark.parametrize("check", ["crc_ok", "reply_fits"])
def test_a_client_that_looks_less_closely_is_found_out(monkeypatch: pytest.MonkeyPatch, check: str) -> None:
    monkeypatch.setattr(frames, check, lambda *_: True)
    rng = Random(7)
    with pytest.raises(AssertionError):
        sum(play(script(rng)) for _ in range(600))


def test_a_corpus_is_the_same_every_time(tmp_path: Path) -> None:
    for folder in ("a", "b"):
        write(tmp_path / folder, 20)
    streams = [sorted(path.name for path in (tmp_path / folder / "modbus_tcp").iterdir()) for folder in ("a", "b")]
    assert streams[0] == streams[1]
