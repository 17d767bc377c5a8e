"""F43: a write that times out is never repeated: 0B, "unknown" until it was read back, what was known is forgotten."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from gateway.core.site import Device, Outcome, Site
from gateway.core.snapshot import DeviceState, Snapshot
from gateway.core.write_ledger import Fate
from gateway.errors import ReplyMismatch, ReplyTimeout, Unconfirmed
from gateway.faces.modbus import writer
from tests.core.test_engine import Registers
from tests.core.virtual_line import make_line
from tests.faces.modbus.writing import MAP, ControllerLine, writing

WRITE = bytes.fromhex("06 e000 4b64")


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


@pytest.mark.parametrize("max_age_s", [5.0, 60.0], ids=["as before", "another age"])
async def test_nor_is_what_they_read_between_a_reload_and_the_write(tmp_path: Path, max_age_s: float) -> None:
    async with writing(tmp_path) as it:
        await it.connect()
        it.line.held = True
        it.ask("06 e000 4b64")
        await it.until(lambda: it.line.waiting)
        while not it.line.waiting[0].write:
            it.line.release()
            await it.until(lambda: it.line.waiting)
        it.server.adjust(replace(it.server.settings, max_age_s=max_age_s), it.site, None)
        it.ask("03 e000 0001", client=1)
        await it.until(lambda: len(it.line.waiting) == 2)
        it.line.waiting.rotate()  # the read goes out first, for the write still had to be put down
        it.line.held = False
        it.line.release()
        assert await it.answer(client=1) != "03024b64"
        assert await it.answer() == "06e0004b64"
        assert await it.query("03 e000 0001", client=1) == "03024b64"


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


def devices(line: ControllerLine, *addresses: int) -> Site:
    """A site like that of `writing`, with the controllers of these addresses as units 11, 12 and so on."""
    found = [
        Device(f"array-{address}", unit, address, MAP, snapshot=Snapshot(state=DeviceState.ONLINE))
        for unit, address in enumerate(addresses, 11)
    ]
    for device in found:
        device.line = line
    return Site.of("ridge-07", [line], found)


async def test_another_controller_that_has_the_unit_id_by_then_is_not_asked(tmp_path: Path) -> None:
    """A reload may give unit ids to others; to read back there would settle what nobody knows by a foreign register."""
    async with writing(tmp_path) as it:
        it.poll()
        it.line.lost.update(write=1, read=1)
        assert await it.query("05 0001 ff00") == "850b"
        await it.until(lambda: it.fates() == [Fate.UNKNOWN])
        server, line, writer = it.server, it.line, it.server.writer
        assert writer is not None
        line.held = True
        for addresses in ((2, 1), (2,), ()):
            server.adjust(server.settings, devices(line, *addresses), None)
            writer._settle_now()
            assert not line.waiting
        server.adjust(server.settings, devices(line, 1, 2), None)
        writer._settle_now()
        assert [ticket.device.address for ticket in line.waiting] == [1]
        line.release()
        await it.until(lambda: it.fates() == [Fate.WRITTEN])


@pytest.mark.parametrize("addresses", [(2, 1), ()])
async def test_one_that_is_sent_while_its_unit_id_goes_ends_as_it_began(
    tmp_path: Path, addresses: tuple[int, ...]
) -> None:
    async with writing(tmp_path) as it:
        it.poll()
        it.line.held = True
        it.ask("05 0002 ff00")
        await it.until(lambda: it.line.waiting)
        it.server.adjust(it.server.settings, devices(it.line, *addresses), None)
        it.line.lost.update(write=1, read=1)
        it.line.release()
        assert await it.answer() == "850b"
        await it.until(lambda: it.fates() == [Fate.UNKNOWN])
        it.server.adjust(it.server.settings, devices(it.line, *addresses), None)
        assert it.server.writer is not None
        assert sorted(it.server.writer._devices) == [11 + place for place in range(len(addresses))]


class Deaf(Registers):
    """A controller that answers reads, and a write in its own way."""

    def __init__(self, answer: bytes | None) -> None:
        super().__init__(1)
        self.answer = answer
        self.writes = 0

    def handle(self, pdu: bytes, now: float) -> bytes | None:
        if pdu[0] != WRITE[0]:
            return super().handle(pdu, now)
        self.writes += 1
        return self.answer


@pytest.mark.parametrize(
    ("answer", "outcome"),
    [
        pytest.param(None, ReplyTimeout, id="no answer"),
        pytest.param(bytes.fromhex("06 e000 4b65"), ReplyMismatch, id="the answer to another write"),
        pytest.param(bytes.fromhex("86 06"), bytes, id="busy"),
        pytest.param(bytes.fromhex("86 04"), bytes, id="failed"),
    ],
)
@pytest.mark.parametrize("gone", [False, True], ids=["it goes on", "it is gone for a while"])
def test_the_line_sends_it_once_whatever_becomes_of_it(
    answer: bytes | None, outcome: type[Outcome], gone: bool
) -> None:
    unit = Deaf(answer)
    line = make_line(unit, writes=True, retries=5)
    line.run(5.0)
    outcomes: list[Outcome] = []
    line.write(line.devices[0], WRITE, outcomes.append)
    line.run(1.0)
    unit.silent = gone
    line.run(120.0)
    unit.silent = False
    line.run(120.0)
    assert [type(each) for each in outcomes] == [outcome]
    assert unit.writes == 1
    assert sum(frame[1:-2] == WRITE for _, frame in line.sent) == 1


def test_the_line_does_not_send_it_again_when_it_is_open_again() -> None:
    unit = Deaf(None)
    line = make_line(unit, writes=True, retries=5)
    line.run(5.0)
    outcomes: list[Outcome] = []
    line.write(line.devices[0], WRITE, outcomes.append)
    while not unit.writes:
        line.run(0.001)
    line.engine.closed("unplugged", line.now)
    line.run(10.0)
    line.wire.clear()
    line.engine.opened(line.now)
    line.run(60.0)
    assert [type(each) for each in outcomes] == [Unconfirmed]  # not 0A: nobody knows
    assert unit.writes == 1
