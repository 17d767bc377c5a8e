"""A recorded line answers again as it did: late, cut, noisy or not at all."""

from __future__ import annotations

from gateway.modbus.crc import append_crc
from gateway.modbus.recording import Piece, Recording
from gateway.simulator.replay import ReplayedLine

ASK = append_crc(bytes.fromhex("01 03 0012 0001"))
OTHER = append_crc(bytes.fromhex("01 03 0013 0001"))
REPLY = append_crc(bytes.fromhex("01 03 02 1234"))


def line(*pieces: tuple[float, str, bytes]) -> ReplayedLine:
    return ReplayedLine(Recording({}, tuple(Piece(at_s, way == ">", data) for at_s, way, data in pieces)))


def played(one: ReplayedLine, request: bytes, now: float) -> list[tuple[float, bytes]]:
    """What comes for a request, and how long after it."""
    one.receive(request, now)
    found = []
    while (at := one.next_event()) is not None:
        found.append((round(at - now, 6), one.take(at)))
    return found


def test_an_answer_comes_as_it_came_and_when() -> None:
    one = line((1.0, ">", ASK), (1.05, "<", REPLY[:3]), (1.06, "<", REPLY[3:]))
    assert played(one, ASK, 100.0) == [(0.05, REPLY[:3]), (0.06, REPLY[3:])]
    assert (one.answered, one.unknown, one.requests) == (1, 0, 1)


def test_the_same_question_is_answered_in_order_and_then_from_the_beginning() -> None:
    noise = b"\xff\x00"
    one = line((1.0, ">", ASK), (1.1, "<", REPLY), (2.0, ">", ASK), (3.0, ">", ASK), (3.1, "<", noise))
    found = [played(one, ASK, 100.0) for _ in range(4)]
    assert found == [[(0.1, REPLY)], [], [(0.1, noise)], [(0.1, REPLY)]]


def test_a_late_answer_comes_into_the_next_question_as_it_did() -> None:
    one = line((1.0, ">", ASK), (1.6, ">", OTHER), (1.7, "<", REPLY))
    assert played(one, ASK, 100.0) == []
    assert played(one, OTHER, 100.6) == [(0.1, REPLY)]


def test_a_request_may_come_in_pieces_and_what_is_unknown_is_not_answered() -> None:
    one = line((0.5, "<", b"noise before"), (1.0, ">", ASK), (1.1, "<", REPLY))
    one.receive(ASK[:4], 100.0)
    assert played(one, ASK[4:], 100.01) == [(0.1, REPLY)]
    assert played(one, OTHER, 101.0) == []
    assert one.unknown == 1
    assert played(one, ASK, 102.0) == [(0.1, REPLY)]


def test_what_is_on_its_way_is_lost_when_the_adapter_is_pulled() -> None:
    one = line((1.0, ">", ASK), (1.1, "<", REPLY))
    one.receive(ASK, 100.0)
    one.clear()
    assert one.take(200.0) == b""
