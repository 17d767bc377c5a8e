"""A site whose controllers are polled by hand, with all faces in memory: what they keep can be counted."""

from __future__ import annotations

import gc
import tracemalloc
from collections.abc import Iterator
from contextlib import contextmanager
from ipaddress import ip_network
from random import Random

from gateway.core.conditions import Conditions
from gateway.core.device_record import DeviceRecord
from gateway.core.health import Breaker
from gateway.core.scheduler import PollList
from gateway.core.serving import FromMemory, Serving
from gateway.core.site import Device, Site
from gateway.core.snapshot import Block, DeviceState, Snapshot
from gateway.core.stats import ModbusServerStats
from gateway.devices.model import Identification, PollClass, Space
from gateway.devices.plan import PlannedBlock, poll_plan
from gateway.devices.schema import load_map
from gateway.faces.http.exposition import Exposition
from gateway.faces.http.own import Counts
from gateway.faces.http.text import OPENMETRICS, TEXT, _Numbers
from gateway.faces.modbus.hot import HotReplies
from gateway.faces.snmp import reader, wire
from gateway.faces.snmp.agent import SnmpAgent
from gateway.faces.snmp.settings import Community, SnmpSettings
from gateway.simulator.device import SimulatedController
from tests.faces.snmp.stub_site import StubClock, StubLine

MOMENTS = 5
"""How many different moments of the same day the controllers show, one after the other."""

HOST = "127.0.0.1"
REPETITIONS = 30


def forget_numbers() -> None:
    """Empty the memory of written numbers, which the whole process shares: one that the tests before have nearly filled
    up to where a dictionary grows would grow in the middle of a measurement."""
    for each in gc.get_objects():
        if isinstance(each, _Numbers):
            each.clear()


class Controllers:
    """Controllers of one model that show the same few moments again and again."""

    def __init__(self, count: int, model: str = "prostar-mppt") -> None:
        device_map = load_map(model)
        line = StubLine("shelter-a", 1, "/dev/ttyA")
        devices = [Device(f"array-{unit}", unit, unit, device_map) for unit in range(1, count + 1)]
        for device in devices:
            device.line = line
        self.clock = StubClock()
        self.site = Site.of("ridge-07", [line], devices)
        self.records = [DeviceRecord(each, PollList(each, Breaker(Random(1))), self.clock.now) for each in devices]
        self.conditions = Conditions(self.site, (), self.clock.now)
        self.exposition = Exposition(self.site, self.clock, Counts(conditions=self.conditions))
        settings = SnmpSettings(
            listen=((HOST, 0),), communities=(Community("public", (ip_network(HOST),)),), requests_per_s=1e9
        )
        self.agent = SnmpAgent(settings, self.site, self.clock, ModbusServerStats(), conditions=self.conditions)
        self.serving = [Serving(device, max_age_s=5.0, strict_map=False) for device in devices]
        self.hot = HotReplies()
        self._plan = poll_plan(device_map)
        self._moments = [_moment(self._plan, at) for at in range(MOMENTS)]

    def poll(self, moment: int) -> None:
        """Every controller is read a second later; each shows another moment than its neighbour."""
        self.clock.now += 1.0
        for record in self.records:
            words = self._moments[(moment + record.device.unit_id) % MOMENTS]
            if record.state is not DeviceState.ONLINE:
                record.identified(Identification("Morningstar Corp.", "PS-MPPT-25", "v01.01.13"), self.clock.now)
                record.become(DeviceState.ONLINE, self.clock.now)
            for block, data in zip(self._plan, words, strict=True):
                if moment == 0 or block.poll is PollClass.LIVE:
                    # Octets of its own, as they come from a line.
                    own = bytes(bytearray(data))
                    record.store(Block(block.space, block.first, block.count, own, self.clock.now), self.clock.now)
        self.conditions.look(self.clock.now)

    async def scrape(self) -> None:
        """Scrape both formats."""
        for form in (TEXT, OPENMETRICS):
            async for _ in self.exposition.pieces(form):
                pass

    def walk(self) -> int:
        """Walk everything; gives the number of replies."""
        name = wire.object_identifier((1, 3))
        for number in range(1, 1_000_000):
            varbinds = self.ask(reader.GET_BULK, name, number)
            at = 0
            while at < len(varbinds):
                start, end = reader.content(varbinds, at, len(varbinds), 0x30)
                _, name_end = reader.content(varbinds, start, end, 0x06)
                name, at = varbinds[start:name_end], end
                if varbinds[name_end:end] == wire.END_OF_MIB_VIEW:
                    return number
        raise AssertionError("a walk without an end")

    def ask(self, kind: int, name: bytes, number: int = 1) -> bytes:
        """Ask for a name; gives the varbinds of the reply."""
        repetitions = REPETITIONS if kind == reader.GET_BULK else 0
        counts = wire.integer(0x02, number) + wire.integer(0x02, 0) + wire.integer(0x02, repetitions)
        pdu = wire.tlv(kind, counts + wire.tlv(0x30, wire.varbind(name, b"\x05\x00")))
        reply = self.agent.answer(wire.tlv(0x30, b"\x02\x01\x01\x04\x06public" + pdu), HOST)
        assert reply is not None
        _, start, at = reader.version(reply)
        _, at = reader.community(reply, at)
        at, end = reader.content(reply, at, len(reply), wire.RESPONSE)
        for _ in range(3):
            _, at = reader.integer(reply, at, end)
        start, end = reader.content(reply, at, end, 0x30)
        return reply[start:end]

    def read(self) -> None:
        """Read a range of every block of every controller by Modbus TCP."""
        for serving in self.serving:
            for block in self._plan:
                function = 1 if block.space is Space.COILS else 3
                pdu = bytes((function,)) + block.first.to_bytes(2) + min(block.count, 40).to_bytes(2)
                answer = serving.answer(pdu, self.clock.now)
                if isinstance(answer, FromMemory):
                    self.hot.keep(bytes((serving.device.unit_id,)) + pdu, serving.device, answer, answer.reply)

    async def everything(self, moment: int) -> None:
        """A poll, and everybody asks for everything."""
        self.poll(moment)
        self.read()
        await self.scrape()
        self.walk()


def _moment(plan: list[PlannedBlock] | tuple[PlannedBlock, ...], at: int) -> list[bytes]:
    unit = SimulatedController(load_map("prostar-mppt"), seed=at, start_hour=6.0 + at)
    found = []
    for block in plan:
        words = unit.read(block.space, block.first, block.count, 0.0)
        if block.space is Space.COILS:
            bits = sum(bool(bit) << place for place, bit in enumerate(words))
            found.append(bits.to_bytes((block.count + 7) // 8, "little"))
        else:
            found.append(b"".join(word.to_bytes(2) for word in words))
    return found


def snapshots() -> int:
    """How many snapshots there are in the process."""
    gc.collect()
    return sum(isinstance(each, Snapshot) for each in gc.get_objects())


@contextmanager
def traced() -> Iterator[None]:
    """Count what is allocated within."""
    tracemalloc.start()
    try:
        yield
    finally:
        tracemalloc.stop()


def allocated() -> int:
    """Octets that were allocated since `traced` began, and are still in use."""
    gc.collect()
    return tracemalloc.get_traced_memory()[0]
