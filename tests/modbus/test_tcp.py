"""The Modbus TCP client: its own replies and no others, whatever the stream is made of."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.errors import ConnectionLost, IllegalDataValue, ReplyMismatch, ReplyTimeout
from gateway.modbus.counters import RtuCounters, UpstreamCounters
from gateway.modbus.habits import CLOSES_WITHIN_S, LOOK_AGAIN_S
from gateway.modbus.mbap import encode
from gateway.modbus.pdu import Function, ReadRequest, is_exception, read_identification_request, reply_fits
from gateway.modbus.tcp import FINISHED, TcpClient
from gateway.modbus.transactions import Ended, Failed, Replied

TIMEOUT_S = 1.0


def request(first: int = 0, count: int = 2, function: int = Function.READ_HOLDING_REGISTERS) -> bytes:
    return ReadRequest(function, first, count).encode()


def reply(pdu: bytes, seed: int = 0) -> bytes:
    """A reply of the right shape whose words tell the request's first address."""
    read = ReadRequest(pdu[0], int.from_bytes(pdu[1:3], "big"), int.from_bytes(pdu[3:5], "big"))
    size = read.reply_size - 2
    return (
        bytes((pdu[0], size)) + ((read.address + seed) & 0xFFFF).to_bytes(2, "big") * (size // 2) + b"\0" * (size % 2)
    )


class Client:
    """A client with its counters, connected."""

    def __init__(self, most: int = 8, first_tid: int = 100, connections: int = 1, *, known: bool = True) -> None:
        self.wire = RtuCounters()
        self.upstream = UpstreamCounters()
        self.tcp = TcpClient(self.wire, self.upstream, most=most, first_tid=lambda: first_tid, connections=connections)
        if known:  # to keep its connections
            self.tcp.connected(-10.0)
            self.exchange(now=-10.0)
            self.exchange(now=-9.0)
            self.tcp.lost(-9.0, remote=False)
        self.tcp.connected(0.0)

    def send(self, unit: int = 1, pdu: bytes | None = None, now: float = 0.0) -> tuple[int, bytes]:
        pdu = request() if pdu is None else pdu
        tid, frame = self.tcp.send(unit, pdu, now, TIMEOUT_S)
        assert frame == encode(tid, unit, pdu)
        return tid, pdu

    def exchange(self, count: int = 1, now: float = 0.0) -> None:
        for _ in range(count):
            tid, pdu = self.send(now=now)
            assert kinds(self.tcp.receive(encode(tid, 1, reply(pdu)), now)) == ["reply"]

    def widen(self) -> None:
        """Until the window is as wide as it gets."""
        self.exchange(40)
        assert self.tcp.window == 8


def patched(data: bytes, at: int, piece: bytes) -> bytes:
    return data[:at] + piece + data[at + len(piece) :]


def kinds(ended: Sequence[Ended]) -> list[str]:
    return ["reply" if isinstance(event, Replied) else event.error.label for _, event in ended]


def blame(ended: Sequence[Ended]) -> list[bool]:
    return [isinstance(event, Failed) and not event.blameless for _, event in ended]


def test_the_first_request_of_a_connection_is_alone_then_the_window_opens() -> None:
    client = Client()
    client.widen()
    client.tcp.lost(1.0, remote=True)
    client.tcp.connected(1.0)
    client.send(now=1.0)
    assert client.tcp.ready_at(1.0) == math.inf
    client.tcp.receive(encode(101, 1, reply(request())), 1.0)
    for _ in range(8):
        assert client.tcp.ready_at(1.0) == 1.0
        client.send(now=1.0)
    assert client.tcp.ready_at(1.0) == math.inf


def test_replies_in_any_order_find_their_requests() -> None:
    client = Client()
    client.widen()
    sent = [client.send(unit, request(10 * unit)) for unit in range(1, 9)]
    stream = b"".join(encode(tid, pdu[2] // 10, reply(pdu)) for tid, pdu in reversed(sent))
    ended = client.tcp.receive(stream, 0.5)
    assert [key for key, _ in ended] == [tid for tid, _ in reversed(sent)]
    for (_, event), (_, pdu) in zip(ended, reversed(sent), strict=True):
        assert isinstance(event, Replied)
        assert event.pdu == reply(pdu)
    assert client.tcp.drop is None


@pytest.mark.parametrize(
    ("spoil", "reason", "label"),
    [
        (lambda tid, pdu: encode(tid + 1, 1, reply(pdu)), "transaction_id", None),
        (lambda tid, pdu: encode(tid, 2, reply(pdu)), "unit_id", "mismatch"),
        (lambda tid, pdu: encode(tid, 1, b"\x04" + reply(pdu)[1:]), "mismatch", "mismatch"),
        (lambda tid, pdu: encode(tid, 1, reply(request(0, 3))), "mismatch", "mismatch"),
        (lambda tid, pdu: encode(tid, 1, b"\x84\x02"), "mismatch", "mismatch"),
        (lambda tid, pdu: patched(encode(tid, 1, reply(pdu)), 2, b"\0\1"), "protocol_id", None),
        (lambda tid, pdu: encode(tid, 1, reply(pdu))[:4] + b"\1\1" + b"\0" * 20, "length", None),
        (lambda tid, pdu: encode(tid, 1, reply(pdu)) + b"\x77\x77\x00", "unsolicited", None),
        (lambda tid, pdu: b"\x77\x77\x00", "unsolicited", None),
    ],
)  # fmt: skip
def test_what_is_not_the_reply_ends_the_connection_and_is_never_a_value(
    spoil: object, reason: str, label: str | None
) -> None:
    client = Client()
    client.exchange()
    tid, pdu = client.send()
    assert callable(spoil)
    ended = client.tcp.receive(spoil(tid, pdu), 0.1)
    assert client.tcp.drop == reason
    assert kinds(ended) == ([] if label is None else [label])
    assert client.tcp.receive(encode(tid, 1, reply(pdu)), 0.2) == [], "nothing is taken from it any more"
    lost = client.tcp.lost(0.2, remote=False)
    assert kinds(lost) == (["connection_lost"] if label is None else [])
    assert client.upstream.lost == {reason: 1}


def test_a_reply_that_lost_its_end_is_not_made_whole_by_the_next() -> None:
    client = Client()
    client.widen()
    one, two = client.send(pdu=request(1, 10)), client.send(pdu=request(2, 10))
    torn = encode(one[0], 1, reply(one[1]))[:20]
    assert client.tcp.receive(torn, 0.1) == []
    assert client.tcp.receive(encode(two[0], 1, reply(two[1])), 0.2) == []
    assert client.tcp.drop is not None


@pytest.mark.parametrize("together", [True, False])
@pytest.mark.parametrize(
    ("asked", "answered"),
    [
        (request(0x20, 1, Function.READ_COILS), b"\1\1\0"),
        (request(0x20, 1, Function.READ_COILS), b"\x81\2"),
        (request(0x20, 30), b"\3\x3c" + bytes(60)),
        (read_identification_request(), bytes.fromhex("2b0e01010000010102") + b"ab"),
    ],
)
def test_a_reply_that_lost_its_end_is_not_made_whole_by_all_of_the_next(
    asked: bytes, answered: bytes, together: bool
) -> None:
    client = Client()
    client.widen()
    one, two = client.send(pdu=request(1, 82)), client.send(pdu=asked)
    next_whole = encode(two[0], 1, answered)
    torn = encode(one[0], 1, reply(one[1]))[: -len(next_whole)]
    pieces = [torn + next_whole] if together else [torn, next_whole]
    assert [ended for piece in pieces for ended in client.tcp.receive(piece, 0.1)] == []
    assert client.tcp.drop == "length"
    assert kinds(client.tcp.lost(0.2, remote=False)) == ["connection_lost"] * 2


def test_nor_by_all_of_a_late_one() -> None:
    client = Client()
    client.widen()
    slow, pdu = client.send(now=0.0)
    quick, _ = client.send(now=0.1)
    client.tcp.receive(encode(quick, 1, reply(pdu)), 0.5)
    client.tcp.on_timer(1.0)
    tid, long = client.send(pdu=request(1, 82), now=1.1)
    late = encode(slow, 1, reply(pdu))
    assert client.tcp.receive(encode(tid, 1, reply(long))[: -len(late)] + late, 1.2) == []
    assert client.tcp.drop == "length"


def test_a_late_reply_is_thrown_away_where_later_ones_were_answered() -> None:
    client = Client()
    client.widen()
    slow, pdu = client.send(1, request(1), now=0.0)
    quick, _ = client.send(2, request(2), now=0.1)
    assert kinds(client.tcp.receive(encode(quick, 2, reply(request(2))), 0.5)) == ["reply"]
    ended = client.tcp.on_timer(1.0)
    assert kinds(ended) == ["timeout"]
    assert client.tcp.drop is None, "the server is alive"
    assert client.tcp.receive(encode(slow, 1, reply(pdu)), 1.2) == []
    assert client.tcp.drop is None
    assert client.upstream.late_replies == 1
    assert client.tcp.receive(encode(slow, 1, reply(pdu)), 1.3) == []
    assert client.tcp.drop == "transaction_id", "nobody waits for a second copy"


def test_a_connection_on_which_nothing_comes_is_dropped() -> None:
    client = Client()
    client.widen()
    for _ in range(3):
        client.send()
    assert client.tcp.next_deadline() == TIMEOUT_S
    assert kinds(client.tcp.on_timer(TIMEOUT_S)) == ["timeout"] * 3
    assert client.tcp.drop == "timeout"
    assert client.tcp.ready_at(TIMEOUT_S) == math.inf


def test_transaction_ids_that_may_still_be_answered_are_not_used_again() -> None:
    client = Client(first_tid=0xFFFF)
    client.widen()
    retired, _ = client.send()
    later, pdu = client.send(now=0.1)
    client.tcp.receive(encode(later, 1, reply(pdu)), 0.2)
    client.tcp.on_timer(1.0)
    used = set()
    for _ in range(0x10000):
        tid, pdu = client.send(now=2.0)
        used.add(tid)
        client.tcp.receive(encode(tid, 1, reply(pdu)), 2.0)
    assert retired not in used
    assert len(used) == 0xFFFF


def test_a_server_is_silent_when_several_units_hear_nothing_on_three_connections() -> None:
    client = Client()
    for now, unit in ((0.0, 1), (2.0, 1), (4.0, 1)):
        client.send(unit, now=now)
        client.tcp.on_timer(now + TIMEOUT_S)
        client.tcp.lost(now + TIMEOUT_S, remote=False)
        assert not client.tcp.silent, "one unit alone may be dead"
        client.tcp.connected(now + TIMEOUT_S)
    client.send(2, now=6.0)
    client.tcp.on_timer(7.0)
    client.tcp.lost(7.0, remote=False)
    assert client.tcp.silent
    client.tcp.reset(8.0)
    client.tcp.connected(8.0)
    assert client.tcp.silent, "until it answers"
    client.exchange(now=8.0)
    assert not client.tcp.silent


def test_who_is_to_blame() -> None:
    client = Client()
    client.send()
    assert blame(client.tcp.lost(0.0, remote=True)) == [True], "it was the first on its connection, and alone"
    client.tcp.connected(0.0)
    client.exchange(2)
    client.send()
    assert blame(client.tcp.lost(0.0, remote=True)) == [False], "the connection had answered before"
    client.tcp.connected(0.0)
    client.widen()
    client.send(now=0.0)
    assert blame(client.tcp.on_timer(TIMEOUT_S)) == [True], "it was alone"
    client.tcp.lost(2.0, remote=False)
    client.tcp.connected(2.0)
    client.exchange(now=2.0)
    client.send(now=2.0)
    client.send(now=2.1)
    assert blame(client.tcp.on_timer(4.0)) == [False, False], "they were together"


def test_a_request_that_is_answered_only_alone_closes_the_window() -> None:
    client = Client()
    client.widen()
    client.send()
    client.send()
    client.tcp.on_timer(TIMEOUT_S)
    client.tcp.lost(TIMEOUT_S, remote=False)
    assert client.tcp.window == 8
    client.tcp.connected(TIMEOUT_S)
    client.exchange(now=TIMEOUT_S)
    assert client.tcp.window == 1


def test_a_server_that_closes_after_every_reply_is_asked_once_a_connection() -> None:
    client = Client(known=False)
    for _ in range(2):
        client.exchange()
        assert client.tcp.ready_at(0.0) == CLOSES_WITHIN_S, "its habit is not known yet, and nothing is risked"
        assert not client.tcp.lost(0.0, remote=True), "nothing is lost by learning it"
        client.tcp.connected(0.0)
    assert client.upstream.lost == {"finished": 2}
    client.exchange()
    assert client.tcp.ready_at(0.0) == math.inf
    assert not client.tcp.drop, "closing is left to the server"
    assert client.tcp.next_deadline() == CLOSES_WITHIN_S
    client.tcp.on_timer(CLOSES_WITHIN_S)
    assert client.tcp.drop == FINISHED
    client.tcp.lost(1.0, remote=False)
    client.tcp.connected(LOOK_AGAIN_S + 1.0)
    client.exchange(now=LOOK_AGAIN_S + 1.0)
    client.exchange(2, now=LOOK_AGAIN_S + 1.0 + CLOSES_WITHIN_S)
    client.tcp.lost(LOOK_AGAIN_S + 2.0, remote=True)
    client.tcp.connected(LOOK_AGAIN_S + 2.0)
    client.exchange(3, now=LOOK_AGAIN_S + 2.0)


def test_a_request_that_has_no_meaning_changes_nothing() -> None:
    client = Client()
    with pytest.raises(ValueError, match="address"):
        client.tcp.send(248, request(), 0.0, TIMEOUT_S)
    with pytest.raises(IllegalDataValue):
        client.tcp.send(1, b"\x03\0\0\0\0", 0.0, TIMEOUT_S)
    client.send()
    with pytest.raises(RuntimeError):
        client.tcp.send(1, request(), 0.0, TIMEOUT_S)
    assert client.tcp.next_deadline() == TIMEOUT_S


def test_a_connection_that_comes_and_goes_reports_everything_once() -> None:
    client = Client()
    client.widen()
    sent = {client.send()[0] for _ in range(5)}
    assert {key for key, _ in client.tcp.lost(0.1, remote=True)} == sent
    assert client.tcp.lost(0.1, remote=True) == ()
    assert client.tcp.next_deadline() is None
    assert client.tcp.receive(b"\0\1", 0.2) == []
    client.tcp.reset(0.3)
    assert client.tcp.ready_at(0.3) == math.inf


errors = (ConnectionLost, ReplyMismatch, ReplyTimeout)
numbers = st.integers(0, 7)
pieces = st.lists(st.one_of(st.binary(max_size=40), numbers, st.tuples(numbers, st.integers(0, 60))))


def play(chunks: Sequence[bytes], width: int) -> tuple[list[Ended], str | None, dict[int, bytes]]:
    client = Client()
    client.widen()
    sent = {}
    for k in range(width):
        tid, pdu = client.send(1 + k % 3, request(100 * k, 1 + k))
        sent[tid] = pdu
    ended: list[Ended] = []
    for chunk in chunks:
        ended += client.tcp.receive(chunk, 0.1)
    drop = client.tcp.drop
    ended += client.tcp.on_timer(5.0)
    ended += client.tcp.lost(5.0, remote=False)
    return ended, drop, sent


@given(parts=pieces, width=st.integers(1, 8))
def test_any_stream_ends_every_request_once_and_replies_fit(
    parts: list[bytes | int | tuple[int, int]], width: int
) -> None:
    """Streams of right replies, pieces of them and noise."""
    client = Client()
    client.widen()
    replies = []
    for k in range(width):
        tid, pdu = client.send(1 + k % 3, request(100 * k, 1 + k))
        replies.append(encode(tid, 1 + k % 3, reply(pdu)))
    stream = b""
    for part in parts:
        if isinstance(part, bytes):
            stream += part
        elif isinstance(part, int):
            stream += replies[part % width]
        else:
            stream += replies[part[0] % width][: part[1]]
    ended, _, sent = play([stream], width)
    assert sorted(key for key, _ in ended) == sorted(sent)
    for key, event in ended:
        if isinstance(event, Replied):
            assert reply_fits(sent[key], event.pdu)
            assert is_exception(event.pdu) or len(event.pdu) >= 2
        else:
            assert isinstance(event.error, errors)


@given(cuts=st.lists(st.integers(0, 200), max_size=12), order=st.permutations(range(6)), noise=st.binary(max_size=12))
def test_however_the_stream_is_cut_the_same_requests_are_answered_or_fewer(
    cuts: list[int], order: list[int], noise: bytes
) -> None:
    """What comes in one piece with noise is not believed; what came before the noise was there is."""
    client = Client()
    client.widen()
    stream = b""
    sent = [client.send(1 + k % 3, request(100 * k, 1 + k)) for k in range(6)]
    for k in order:
        tid, pdu = sent[k]
        stream += encode(tid, 1 + k % 3, reply(pdu))
    edges = [0, *sorted(cut % (len(stream) + 1) for cut in cuts), len(stream)]
    chunks = [stream[a:b] for a, b in pairwise(edges)]
    clean, drop, pdus = play(chunks, 6)
    assert drop is None
    assert [kind for kind in kinds(clean) if kind == "reply"] == ["reply"] * 6
    for key, event in clean:
        assert isinstance(event, Replied)
        assert event.pdu == reply(pdus[key])
    noisy, _, _ = play([*chunks, noise], 6)
    assert [event for _, event in noisy if isinstance(event, Replied)] == [event for _, event in clean]
