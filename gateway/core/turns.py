"""Small questions about turns: who waits for one, what it asks for, and whose part of a reply is whose."""

from __future__ import annotations

from gateway.core.coalescing import part
from gateway.core.requests import ClientRead, ReadTurn, Span, Turn, Waiter, WriteTurn
from gateway.core.site import Device
from gateway.devices.model import Point
from gateway.errors import IllegalFunction
from gateway.modbus.pdu import Function, parse_read

_READS = frozenset(
    {
        Function.READ_COILS,
        Function.READ_DISCRETE_INPUTS,
        Function.READ_HOLDING_REGISTERS,
        Function.READ_INPUT_REGISTERS,
    }
)


def is_wanted(turn: Turn) -> bool:
    """Whether anybody still waits for it."""
    if isinstance(turn, ReadTurn):
        return any(read.wanted for read in turn.reads)
    return not (isinstance(turn, WriteTurn) and turn.waiter.left)


def waiters_of(turn: Turn) -> list[Waiter]:
    """Who waits for it; nobody for a poll."""
    if isinstance(turn, ReadTurn):
        if len(turn.reads) == 1:
            return turn.reads[0].waiters
        return [waiter for read in turn.reads for waiter in read.waiters]
    return [turn.waiter] if isinstance(turn, WriteTurn) else []


def clients_of(turn: Turn) -> list[str]:
    """Who asked for it, each client once; nobody for a poll."""
    waiters = waiters_of(turn)
    if len(waiters) == 1:
        return [waiters[0].client]
    return list(dict.fromkeys(waiter.client for waiter in waiters))


def part_of(turn: ReadTurn, read: ClientRead, reply: bytes) -> bytes:
    """The read's own part of a turn's reply."""
    if len(turn.reads) == 1 or turn.span is None or read.span is None:
        return reply
    return part(reply, turn.span, read.span)


def span_of(device: Device, pdu: bytes) -> Span | None:
    """What a read asks for; None for identification. Raises the RequestError that refuses anything else."""
    if pdu and pdu[0] in _READS and pdu[0] in device.map.functions:
        return Span.of(device, parse_read(pdu))
    if pdu and pdu[0] == Function.READ_IDENTIFICATION:
        return None
    raise IllegalFunction("only reads are sent")


def written_point(device: Device, pdu: bytes) -> Point | None:
    """The point that a write is for, as far as the map names it."""
    space = device.map.write_functions.get(pdu[0])
    return None if space is None else device.map.writable_point(space, int.from_bytes(pdu[1:3], "big"))
