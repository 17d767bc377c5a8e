"""One receiver in virtual time: what is sent when, what is sent again, and what waits."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

import pytest
from pyasn1.codec.ber import decoder
from pysnmp.proto import rfc1905

from gateway.core.conditions import Severity
from gateway.core.stats import NotifyStats
from gateway.faces.snmp import delivery as module
from gateway.faces.snmp.delivery import Delivery, Note
from gateway.faces.snmp.layout import shipped_layout
from gateway.faces.snmp.notifications import AUTHENTICATION_FAILURE, COLD_START
from gateway.faces.snmp.notify_pdu import PduWriter
from gateway.faces.snmp.secret import Secret
from gateway.faces.snmp.settings import Oid, Receiver
from tests.core.test_conditions import Plant

LAYOUT = shipped_layout()
TRAP_OID = (1, 3, 6, 1, 6, 3, 1, 1, 4, 1, 0)


def read(pdu: bytes) -> tuple[str, dict[Oid, Any]]:
    """Class of a PDU and its variable bindings, by pysnmp."""
    found, rest = decoder.decode(pdu, asn1Spec=rfc1905.PDUs())
    assert rest == b""
    read_pdu = found.getComponent()
    values = {tuple(pair[0]): pair[1].getComponent().getComponent().getComponent() for pair in read_pdu[3]}
    return type(read_pdu).__name__, values


class Post:
    """A receiver, and one device to tell of."""

    def __init__(self, **changes: object) -> None:
        receiver = Receiver("192.0.2.7", 162, inform=True, community=Secret(b"c"), hold_s=1.0)
        receiver = replace(receiver, **changes)  # type: ignore[arg-type]
        self.plant = Plant()
        self.stats = NotifyStats(receiver.label, "inform" if receiver.inform else "trap")
        writer = PduWriter(LAYOUT, "ridge", lambda at: int(at * 100), inform=receiver.inform)
        self.delivery = Delivery(receiver, writer, self.stats, 0.0)
        self.shows()

    @property
    def now(self) -> float:
        return self.plant.now

    def shows(self, **values: int) -> None:
        self.plant.shows(**values)
        self.delivery.changed(self.plant.conditions.take(), self.now)

    def send(self, *, works: bool = True) -> list[Note]:
        notes = self.delivery.outgoing(self.now)
        for note in notes:
            (self.delivery.sent if works else self.delivery.not_sent)(note, self.now)
        return notes

    def send_all(self) -> list[Note]:
        out: list[Note] = []
        while notes := self.send():
            out += notes
        return out

    def silent(self) -> bool:
        return self.delivery.silent

    def acknowledge(self, *notes: Note) -> None:
        for note in notes:
            self.delivery.acknowledged(note.request_id, self.now)

    def sequences(self, notes: list[Note]) -> list[int]:
        oid = (*LAYOUT.objects, 10, 1, 0)
        return [int(read(note.pdu)[1][oid]) for note in notes]


def kinds(notes: list[Note]) -> list[Oid]:
    return [tuple(read(note.pdu)[1][TRAP_OID]) for note in notes]


def test_the_first_thing_is_a_cold_start() -> None:
    post = Post()
    [note] = post.send()
    kind, values = read(note.pdu)
    assert kind == "InformRequestPDU"
    assert list(values)[:2] == [(1, 3, 6, 1, 2, 1, 1, 3, 0), TRAP_OID]
    assert tuple(values[TRAP_OID]) == COLD_START
    assert bytes(values[*LAYOUT.objects, 1, 1, 0]) == b"ridge"


def test_a_notification_has_the_objects_of_the_mib_in_their_order() -> None:
    post = Post(inform=False)
    post.send_all()
    post.plant.device.snapshot = replace(post.plant.device.snapshot, values={"battery_voltage": 24.5})
    post.shows(array_faults=1 << 3, battery_voltage=24.5)  # type: ignore[arg-type]
    [note] = post.send()
    kind, values = read(note.pdu)
    condition, notify = (*LAYOUT.objects, 8, 1), (*LAYOUT.objects, 10)
    assert kind == "SNMPv2TrapPDU"
    assert {oid: value.prettyPrint() for oid, value in list(values.items())[1:]} == {
        TRAP_OID: ".".join(map(str, (*LAYOUT.notifications, 1))),
        (*notify, 1, 0): "2",
        (*notify, 2, 0): "1",
        (*LAYOUT.objects, 1, 1, 0): "ridge",
        (*notify, 3, 0): "d",
        (*condition, 3, 7, 103): "array_fault_battery_hvd",
        (*condition, 4, 7, 103): "battery high-voltage disconnect",
        (*condition, 5, 7, 103): "3",
        (*condition, 6, 7, 103): "2",
        (*notify, 4, 0): "24500",
    }


def test_until_the_first_acknowledgement_one_inform_is_under_way() -> None:
    post = Post()
    post.shows(array_faults=0xFFF)
    [first] = post.send()
    assert post.send() == []
    post.acknowledge(first)
    notes = post.send()
    assert len(notes) == module.WINDOW
    assert post.sequences([first, *notes]) == list(range(1, 10))
    assert post.send() == []
    post.acknowledge(*notes)
    assert len(post.send()) == 12 - module.WINDOW


def test_an_inform_is_repeated_until_it_is_acknowledged() -> None:
    post = Post()
    [first] = post.send()
    gaps = []
    for _ in range(8):
        before, deadline = post.now, post.delivery.next_deadline(post.now)
        assert deadline is not None
        gaps.append(deadline - before)
        post.plant.wait(gaps[-1])
        assert post.send() == [first]
    assert gaps == [2, 4, 8, 16, 32, 60, 60, 60]
    assert post.silent()
    post.acknowledge(first)
    assert not post.silent()
    assert post.delivery.next_deadline(post.now) is None
    assert (post.stats.notifications, post.stats.sent, post.stats.repeated, post.stats.acknowledged) == (1, 9, 8, 1)


def test_a_receiver_that_falls_silent_gets_one_inform_at_a_time_and_then_all() -> None:
    post = Post()
    post.acknowledge(*post.send())
    post.shows(array_faults=0xFF)
    notes = post.send()
    for _ in range(4):
        post.plant.wait(60)
        post.send()
    assert post.send() == []
    post.plant.wait(60)
    assert post.send() == notes[:1]
    post.acknowledge(notes[0])
    assert post.send() == notes[1:]


def test_the_receiver_may_ask_twice_for_a_repetition() -> None:
    post = Post()
    [note] = post.send()
    for _ in range(2):
        post.delivery.again(note.request_id, post.now)
        assert post.send() == [note]
    post.delivery.again(note.request_id, post.now)
    assert post.send() == []
    assert post.delivery.next_deadline(post.now) == post.now + module.FIRST_S
    post.plant.wait(module.FIRST_S)
    assert post.send() == [note]
    post.delivery.again(note.request_id, post.now)
    assert post.send() == [note]


def test_answers_to_what_was_never_asked_are_nothing() -> None:
    post = Post()
    [note] = post.send()
    post.delivery.acknowledged(note.request_id + 1, post.now)
    post.delivery.again(note.request_id + 1, post.now)
    assert post.stats.acknowledged == 0
    post.acknowledge(note, note)
    assert post.stats.acknowledged == 1


def test_traps_go_once_and_no_faster_than_allowed() -> None:
    post = Post(inform=False, per_minute=6.0)
    post.shows(array_faults=0xFFF)
    assert len(post.send_all()) == 6
    deadline = post.delivery.next_deadline(post.now)
    assert deadline is not None
    assert post.now < deadline <= post.now + 10
    post.plant.wait(60)
    assert len(post.send_all()) == 6
    post.plant.wait(60)
    notes = post.send_all()
    assert len(notes) == 1
    assert (post.stats.notifications, post.stats.waiting) == (13, 0)


def test_a_trap_that_the_system_does_not_take_is_told_anew_and_leaves_no_gap() -> None:
    post = Post(inform=False)
    [lost] = post.send(works=False)
    assert post.send() == []
    assert post.delivery.next_deadline(post.now) == post.now + module.FIRST_S
    post.plant.wait(module.FIRST_S)
    post.shows(array_faults=1)
    [again] = post.send()
    assert kinds([lost, again]) == [COLD_START, COLD_START]
    [lost] = post.send(works=False)
    post.plant.wait(module.LAST_S)
    [told] = post.send_all()
    assert kinds([lost]) == kinds([told]) == [(*LAYOUT.notifications, 1)]
    assert post.sequences([again, told]) == [1, 2]
    assert post.stats.failures == 2


def test_wrong_credentials_are_told_once_a_minute() -> None:
    post = Post(inform=False)
    post.send_all()
    for _ in range(1000):
        post.delivery.authentication_failed(post.now)
        post.plant.wait(0.1)
    assert kinds(post.send_all()) == [AUTHENTICATION_FAILURE]
    assert post.stats.notifications == 2


@pytest.mark.parametrize(
    ("values", "number"),
    [({"array_faults": 1}, 1), ({"load_state": 3}, 5)],
)
def test_kinds(values: dict[str, int], number: int) -> None:
    post = Post(inform=False)
    post.send_all()
    post.shows(**values)
    raised = post.send_all()
    post.plant.wait(10)
    post.shows()
    assert kinds(raised + post.send_all()) == [(*LAYOUT.notifications, number), (*LAYOUT.notifications, number + 1)]


def test_a_receiver_of_what_is_critical() -> None:
    post = Post(inform=False, least=Severity.CRITICAL)
    post.send_all()
    post.shows(alarms=1 | 1 << 17)
    assert len(post.send_all()) == 1


def test_a_trap_that_the_system_does_not_take_is_tried_ever_more_seldom() -> None:
    post = Post(inform=False)
    tried = []
    for second in range(300):
        if post.send(works=False):
            tried.append(second)
        post.plant.wait(1)
    assert [later - earlier for earlier, later in pairwise(tried)] == [2, 4, 8, 16, 32, 60, 60, 60]
    post.plant.wait(60)
    assert len(post.send()) == 1
    assert post.stats.failures == len(tried)
