"""Joining reads that wait for one device into one transaction.

Rule 1: reads are joined when that is cheaper on the wire than making them apart, all bytes, gaps and the
        device's turnaround counted; at 9600 baud a hole of about a dozen registers is bridged.
Rule 2: what is bridged lies in the map, so that the device answers it; a range that leaves the map is only ever
        asked for as its client asked.
Rule 3: a joined read is no longer than the protocol and the device allow.
Rule 4: each waiter gets its own part, with its own function code. An exception to a joined read is nobody's
        answer: the reads are made again, apart (the engine does that).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

from gateway.core.requests import ClientRead, Span
from gateway.devices.model import Space

Cost = Callable[[Space, int], float]
"""Seconds of line time of one read of so many registers or coils."""

Mapped = Callable[[Space, int, int], bool]
"""Whether all addresses from first to one before end are in the device's map."""


def join(
    head: ClientRead, others: Iterable[ClientRead], *, cost: Cost, mapped: Mapped, most: Callable[[Space], int]
) -> tuple[Span | None, tuple[ClientRead, ...]]:
    """The span to read for `head` and whoever of `others` can share it; `head` is always the first of them."""
    if head.span is None or head.alone:
        return head.span, (head,)
    span = head.span
    joined = [head]
    waiting = [read for read in others if read is not head and read.span is not None and not read.alone]
    if not waiting:
        return span, (head,)
    # Nearest first, and again after each success: the union grows and reaches further.
    while (near := _nearest(span, waiting, cost=cost, mapped=mapped, most=most)) is not None:
        span, read = near
        joined.append(read)
        waiting.remove(read)
    return span, tuple(joined)


def part(reply: bytes, whole: Span, wanted: Span) -> bytes:
    """The reply PDU to `wanted`, cut out of the reply PDU to `whole`."""
    offset = wanted.first - whole.first
    if whole.space is Space.REGISTERS:
        data = reply[2 + 2 * offset : 2 + 2 * (offset + wanted.count)]
    else:
        bits = int.from_bytes(reply[2:], "little") >> offset & ((1 << wanted.count) - 1)
        data = bits.to_bytes((wanted.count + 7) // 8, "little")
    return bytes((wanted.function, len(data))) + data


def _nearest(
    span: Span, waiting: Sequence[ClientRead], *, cost: Cost, mapped: Mapped, most: Callable[[Space], int]
) -> tuple[Span, ClientRead] | None:
    best: tuple[float, Span, ClientRead] | None = None
    span_s = cost(span.space, span.count)
    longest = most(span.space)
    for read in waiting:
        other = read.span
        if other is None or other.space is not span.space:
            continue
        first, end = min(span.first, other.first), max(span.end, other.end)
        count = end - first
        if count == span.count:
            return span, read  # inside already: free, whatever the map says of it
        if count > longest:
            continue
        saved_s = span_s + cost(span.space, other.count) - cost(span.space, count)
        if saved_s <= 0 or not mapped(span.space, first, end):
            continue
        if best is None or saved_s > best[0]:
            best = (saved_s, span._replace(first=first, count=count), read)
    return None if best is None else (best[1], best[2])
