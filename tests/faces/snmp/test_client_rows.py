"""Who has which row of the client table."""

from __future__ import annotations

from gateway.core.clients import ClientTable
from gateway.core.ratelimit import ClientRate
from gateway.core.site import Site
from gateway.core.stats import ModbusServerStats
from gateway.faces.snmp.client_rows import MOST_ROWS, REFRESH_S, ClientRows
from gateway.faces.snmp.client_tail import ClientTail
from gateway.faces.snmp.counters import SnmpCounters
from gateway.faces.snmp.layout import shipped_layout
from gateway.faces.snmp.objects import Gateway
from gateway.faces.snmp.reader import oid
from gateway.faces.snmp.settings import EVERYTHING, Oid, View


class Face:
    def __init__(self) -> None:
        self.table = ClientTable(ModbusServerStats(), 2.0)
        self.rows = ClientRows(self.table)
        self.now = 0.0

    def comes(self, name: str, *, goes: bool = False) -> None:
        self.now += 1.0
        client = self.table.arrived(name, ClientRate(), self.now)
        if goes:
            self.table.left(client, self.now)

    def names(self) -> dict[int, str]:
        self.now += REFRESH_S
        found = {number: self.rows.at(number, self.now) for number in range(MOST_ROWS + 2)}
        assert self.rows.present(self.now) == [number for number, client in found.items() if client is not None]
        return {number: client.name for number, client in found.items() if client is not None}


def test_a_client_keeps_its_row() -> None:
    face = Face()
    face.comes("a")
    assert face.names() == {1: "a"}
    face.comes("b")
    face.comes("c")
    assert face.names() == {1: "a", 2: "c", 3: "b"}
    face.comes("b")
    assert face.names() == {1: "a", 2: "c", 3: "b"}


def test_the_longest_gone_makes_room() -> None:
    face = Face()
    for number in range(MOST_ROWS):
        face.comes(f"client-{number}", goes=number % 2 == 1)
        face.names()
    before = face.names()
    face.comes("new")
    after = face.names()
    assert len(after) == MOST_ROWS
    assert {number for number in after if after[number] != before[number]} == {2}
    assert after[2] == "new"


def test_connected_clients_are_not_driven_out() -> None:
    face = Face()
    for number in range(MOST_ROWS + 5):
        face.comes(f"client-{number}")
        face.names()
    assert sorted(face.names().values()) == sorted(f"client-{number}" for number in range(MOST_ROWS))


def test_a_client_that_is_forgotten_leaves_its_row() -> None:
    face = Face()
    face.comes("first", goes=True)
    assert face.names() == {1: "first"}
    face.table._clients.clear()
    assert face.names() == {}


def test_it_is_looked_at_once_a_second() -> None:
    face = Face()
    face.names()
    face.comes("a")
    assert face.rows.at(1, face.now - 0.5) is None
    assert face.rows.at(1, face.now + REFRESH_S) is not None


TABLE = next(table for table in shipped_layout().tables if table.name == "pgwClient")
BASE: Oid = (*TABLE.base, 1)


def walk(tail: ClientTail, now: float, start: Oid = ()) -> list[Oid]:
    return [oid(name) for name, _ in tail.steps(start, now)]


def tail_of(face: Face) -> ClientTail:
    site = Site.of("s", (), ())
    gateway = Gateway(site, "0", 0.0, ModbusServerStats(), SnmpCounters(), "", "", (1, 3), (), clients=face.rows)
    return ClientTail(TABLE, gateway)


def test_only_rows_that_somebody_is_in_have_cells() -> None:
    face = Face()
    tail = tail_of(face)
    assert walk(tail, 0.0) == []
    face.comes("192.0.2.7")
    face.comes("192.0.2.8")
    found = walk(tail, face.now)
    assert found == [(*BASE, column, row) for column in range(2, 11) for row in (1, 2)]
    assert all(tail.get(each, face.now) is not None for each in found)
    assert tail.get((*BASE, 2, 3), face.now) is None
    assert tail.get((*BASE, 2), face.now) is None
    for number, start in enumerate(found, 1):
        assert walk(tail, face.now, start) == walk(tail, face.now, (*start, 5)) == found[number:]
    assert walk(tail, face.now, (*TABLE.base, 2)) == []


def test_a_view_shows_columns_or_nothing() -> None:
    face = Face()
    face.comes("192.0.2.7")
    tail = tail_of(face)
    assert tail.through(EVERYTHING) is tail
    some = tail.through(View((BASE,), ((*BASE, 2), (*BASE, 3, 1))))
    assert {each[-2] for each in walk(some, face.now)} == set(range(4, 11))
    assert some.get((*BASE, 2, 1), face.now) is None
    assert walk(tail.through(View()), face.now) == []
