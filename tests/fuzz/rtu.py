"""The RTU client of one line fed with any bytes at any time: what it delivers is a reply to what it asked, or nothing.

Used by its test with random scripts, and by fuzz_rtu.py with atheris. An input is a script: a request, then what the
line gives. Most of what a fuzzer makes up would fail by its CRC alone, so a step may ask for a right one.
"""

from __future__ import annotations

from collections.abc import Iterator
from random import Random

from gateway.modbus.collector import MAX_BUFFER, Echo
from gateway.modbus.counters import RtuCounters
from gateway.modbus.crc import append_crc
from gateway.modbus.pdu import ReadRequest, read_identification_request, reply_fits
from gateway.modbus.rtu import RtuClient, State, Timing
from gateway.modbus.transactions import Failed, Replied

TIMING = Timing.of(9600, 8, "N", 2)
TIMEOUT_S = 0.5
TRANSACTIONS = 8  # of one script; the rest of a long one is left
REQUESTS = (
    ReadRequest(3, 0x0018, 2).encode(),
    ReadRequest(4, 0x0000, 80).encode(),
    ReadRequest(1, 0x0000, 9).encode(),
    ReadRequest(2, 0x0300, 8).encode(),  # its reply may look like its request
    bytes.fromhex("06 e000 4b64"),
    bytes.fromhex("05 0001 ff00"),
    read_identification_request(0),
)


class Script:
    """Takes an input apart; zeros follow its end."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._at = 0

    def __bool__(self) -> bool:
        return self._at < len(self._data)

    def number(self) -> int:
        """The next byte."""
        return (self.text(1) or b"\0")[0]

    def text(self, size: int) -> bytes:
        """The next bytes, fewer at the end."""
        taken = self._data[self._at : self._at + size]
        self._at += len(taken)
        return taken


def feed(data: bytes) -> int:
    """Play a script; how many replies were delivered. AssertionError when the client broke its word."""
    script = Script(data)
    counters = RtuCounters()
    client = RtuClient(TIMING, counters, quarantine_s=0.05)
    now, delivered = 0.0, 0
    client.reset(now)
    for _ in range(TRANSACTIONS):
        if not script:
            break
        address, request = 1 + script.number() % 3, REQUESTS[script.number() % len(REQUESTS)]
        now = client.ready_at(now)
        sent = client.send(address, request, now, TIMEOUT_S)
        given = bytearray()
        deadline = now + TIMING.wire_s(len(sent)) + TIMEOUT_S + TIMING.wire_s(256)
        ended: Replied | Failed | None = None
        for wait_s, piece in _steps(script, address, request, sent):
            now += wait_s
            ended = client.on_timer(now)
            if ended is None:
                given += piece
                ended = client.receive(piece, now)
            if ended is not None:
                break
            transaction = client._transaction
            assert transaction is not None
            assert transaction.collector.pending <= MAX_BUFFER
            assert client.bytes_due() > 0
        while ended is None:  # the line is silent from now on
            due = client.next_deadline()
            assert due is not None
            assert due <= deadline + 1e-9, "nothing prolongs the wait"
            now = max(now, due)
            ended = client.on_timer(now)
        assert client.state is not State.WAITING
        if isinstance(ended, Replied):
            delivered += 1
            _check(address, request, ended.pdu, bytes(given), echo=client.echo)
    assert all(count >= 0 for count in (counters.noise_bytes, counters.late_bytes, counters.crc_errors))
    return delivered


def _check(address: int, request: bytes, pdu: bytes, given: bytes, *, echo: Echo) -> None:
    """A reply answers the request, came whole in this transaction, and is no echo."""
    assert reply_fits(request, pdu)
    frame = append_crc(bytes((address,)) + pdu)
    assert frame in given
    if pdu == request and echo is Echo.PRESENT:
        assert given.count(frame) > 1, "the first copy is our own request"


def _steps(script: Script, address: int, request: bytes, sent: bytes) -> Iterator[tuple[float, bytes]]:
    """What the line gives, piece by piece, and how long it takes until then."""
    while script:
        kind = script.number()
        wait_s = (0.0, 0.004, 0.03, 0.2)[kind >> 6]
        piece = script.text(script.number())
        match kind % 8:
            case 0:
                return  # silence
            case 1:
                piece = append_crc(bytes((address,)) + piece)
            case 2:
                piece = append_crc(bytes((address, request[0])) + piece)
            case 3:
                piece = append_crc(bytes((address, request[0], len(piece))) + piece)
            case 4:
                piece = append_crc(bytes((1 + (address + 1) % 3, request[0], len(piece))) + piece)
            case 5:
                piece = sent
            case 6:
                piece = append_crc(bytes((address, request[0] | 0x80, len(piece) % 12)))
            case _:
                pass
        yield wait_s, piece


def script(rng: Random) -> bytes:
    """A script of several transactions, some of them with the right reply among other things."""
    out = bytearray()
    for _ in range(rng.randrange(1, 5)):
        index = rng.randrange(len(REQUESTS))
        out += bytes((rng.randrange(256), index))
        for _ in range(rng.randrange(4)):
            size = rng.choice((0, 1, 2, 4, 9, 160, rng.randrange(256)))
            out += bytes((rng.randrange(256), size)) + rng.randbytes(size)
        if rng.random() < 0.7:
            size = {3: 4, 4: 160, 1: 2, 2: 1}.get(REQUESTS[index][0], 0)
            out += bytes((3 if size else 5, size)) + rng.randbytes(size)
            out += bytes((5, 0)) * (not size)
        out += bytes((0, 0))
    return bytes(out)
