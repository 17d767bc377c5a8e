"""Why pysnmp's engine is not our agent (docs/adr/0002): where its access control, its engine and its GETBULK go wrong.

Each xfail says what should happen. It fails on pysnmp 7.1.30; the day it passes, upstream was fixed.
"""

from __future__ import annotations

import gc
import time
from collections.abc import Callable
from importlib.metadata import requires
from pathlib import Path
from typing import Any

import pytest
from pyasn1.codec.ber import decoder
from pysnmp.carrier.asyncio.dgram import udp
from pysnmp.carrier.base import AbstractTransport, AbstractTransportDispatcher
from pysnmp.entity import config
from pysnmp.entity.engine import SnmpEngine
from pysnmp.entity.rfc3413 import cmdrsp, context
from pysnmp.proto import rfc1905
from pysnmp.proto.api import v2c
from pysnmp.proto.rfc1902 import OctetString

from gateway.faces.snmp import wire
from tests.faces.snmp.poller import pdu

SYSTEM = (1, 3, 6, 1, 2, 1, 1)
SYS_CONTACT, SYS_NAME = (*SYSTEM, 4, 0), (*SYSTEM, 5, 0)
USM_KEYS = (1, 3, 6, 1, 4, 1, 20408, 3, 1, 1, 1, 2)
"""pysnmp's own table of users: their pass phrases, in clear."""

PASS_PHRASE = b"correct-horse-1"


class Wire(AbstractTransport):  # type: ignore[misc]  # pysnmp has no types
    """A transport without a network."""

    def __init__(self) -> None:
        self.sent: list[bytes] = []

    def send_message(self, outgoingMessage: bytes, transportAddress: object) -> None:  # noqa: N803 - their names
        """Keep what is sent."""
        self.sent.append(bytes(outgoingMessage))

    def receive(self, data: bytes) -> None:
        """A datagram comes in."""
        assert self._callback_function is not None
        self._callback_function(self, udp.UdpTransportAddress(("127.0.0.1", 16100)), data)


class Agent:
    """pysnmp's engine with its stock responders, put together as its examples do."""

    def __init__(self, engine_id: bytes | None = None) -> None:
        self.engine = SnmpEngine(None if engine_id is None else OctetString(engine_id))
        self.wire = Wire()
        dispatcher = AbstractTransportDispatcher()
        dispatcher.register_transport(udp.DOMAIN_NAME, self.wire)
        self.engine.register_transport_dispatcher(dispatcher)
        config.add_v1_system(self.engine, "reader", "public")
        config.add_v1_system(self.engine, "trapper", "trap-only")
        config.add_v3_user(self.engine, "noc", config.USM_AUTH_HMAC96_SHA, PASS_PHRASE.decode())
        config.add_vacm_user(self.engine, 2, "reader", "noAuthNoPriv", SYSTEM)
        config.add_vacm_user(self.engine, 2, "trapper", "noAuthNoPriv", (), (), SYSTEM)
        tree = context.SnmpContext(self.engine)
        for responder in (cmdrsp.GetCommandResponder, cmdrsp.NextCommandResponder, cmdrsp.SetCommandResponder):
            responder(self.engine, tree)
        cmdrsp.BulkCommandResponder(self.engine, tree)

    def answer(self, body: bytes, community: bytes = b"public") -> Any:
        """The PDU of the one reply; None without one."""
        self.wire.sent.clear()
        self.wire.receive(wire.tlv(0x30, wire.integer(0x02, 1) + wire.tlv(0x04, community) + body))
        if not self.wire.sent:
            return None
        (data,) = self.wire.sent
        message, rest = decoder.decode(data, asn1Spec=v2c.Message())
        assert not rest
        return message["data"].getComponent()


@pytest.fixture
def make(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Agent]:
    """Agents whose traces in the temp directory go with the test."""
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    return Agent


def varbinds(reply: Any) -> list[tuple[tuple[int, ...], Any]]:
    return [(tuple(name), value) for name, value in v2c.apiPDU.get_varbinds(reply)]


def test_the_bench_is_sound(make: Callable[..., Agent]) -> None:
    """A reader reads what its view names."""
    reply = make().answer(pdu(v2c.GetRequestPDU, SYS_NAME))
    assert v2c.apiPDU.get_error_status(reply) == 0
    ((name, value),) = varbinds(reply)
    assert name == SYS_NAME
    assert value.isSameTypeWith(OctetString())


ENGINE_ID = bytes.fromhex("80004fb8056162636465")
MALFORMED = bytes.fromhex("74270201010406707562c96963a01a02021267020100020100300e300c06082b560102010105000500")
"""A message whose tags are not of a message."""


def fails(why: str, raises: type[BaseException] = AssertionError) -> pytest.MarkDecorator:
    return pytest.mark.xfail(raises=raises, strict=True, reason=f"pysnmp 7.1.30 {why}")


@fails("takes a view without entries for one with everything in it")
def test_who_may_read_cannot_write(make: Callable[..., Agent]) -> None:
    agent = make()
    assert v2c.apiPDU.get_error_status(agent.answer(pdu(v2c.SetRequestPDU, SYS_CONTACT))) != 0


@fails("shows its users and their pass phrases to who may only be sent traps")
def test_who_may_only_be_notified_reads_nothing(make: Callable[..., Agent]) -> None:
    agent = make()
    name: tuple[int, ...] = USM_KEYS
    shown = []
    for _ in range(10):
        ((name, value),) = varbinds(agent.answer(pdu(v2c.GetNextRequestPDU, name), b"trap-only"))
        shown.append(bytes(value))
        if value.isSameTypeWith(rfc1905.endOfMibView):
            break
    assert PASS_PHRASE not in shown


@fails("makes another id at each start")
def test_an_engine_has_one_id(make: Callable[..., Agent]) -> None:
    assert make().engine.snmpEngineID == make().engine.snmpEngineID


@pytest.mark.filterwarnings("ignore::ResourceWarning")  # nor does it close the file that it keeps them in
@fails("keeps boots in the temp directory and begins anew where that was emptied")
def test_boots_never_fall(make: Callable[..., Agent], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    before = [boots(make(ENGINE_ID)) for _ in range(3)]
    assert before == sorted(set(before))
    (tmp_path / "after a restart of the machine").mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "after a restart of the machine"))
    after = boots(make(ENGINE_ID))
    gc.collect()
    assert after > before[-1]


def boots(agent: Agent) -> int:
    return int(scalar(agent, "snmpEngineBoots").syntax)


def scalar(agent: Agent, name: str) -> Any:
    (found,) = agent.engine.get_mib_builder().import_symbols("__SNMP-FRAMEWORK-MIB", name)
    return found


@fails("takes the wall clock for the time since its start")
def test_the_engines_time_is_no_wall_clock(make: Callable[..., Agent], monkeypatch: pytest.MonkeyPatch) -> None:
    engine_time = scalar(make(), "snmpEngineTime").syntax
    before, now = int(engine_time.clone()), time.time()
    monkeypatch.setattr("time.time", lambda: now + 3600.0)
    assert int(engine_time.clone()) - before < 60


@fails("raises in the loop's callback and answers nothing", raises=TypeError)
@pytest.mark.parametrize("names", [(), (SYSTEM,)], ids=["no name", "no repetition"])
def test_a_bulk_request_for_nothing_is_answered(make: Callable[..., Agent], names: tuple[tuple[int, ...], ...]) -> None:
    reply = make().answer(pdu(v2c.GetBulkRequestPDU, *names, bulk=(0, 0)))
    assert varbinds(reply) == []


@fails("counts varbinds and not octets")
def test_a_reply_fits_into_a_datagram_of_ethernet(make: Callable[..., Agent]) -> None:
    agent = make()
    agent.answer(pdu(v2c.GetBulkRequestPDU, *[SYSTEM] * 60))
    assert len(agent.wire.sent[0]) <= 1472


@fails("raises in the loop's callback", raises=TypeError)
def test_a_malformed_datagram_is_dropped(make: Callable[..., Agent]) -> None:
    make().wire.receive(MALFORMED)


@fails("takes users with AES and fails at their first packet where cryptography is not installed")
def test_it_asks_for_the_library_that_it_encrypts_with() -> None:
    wanted = [each for each in requires("pysnmp") or () if "extra ==" not in each]
    assert any(each.startswith("cryptography") for each in wanted)
