"""What a line can carry, before it is opened: its projected use and the refresh time of its devices.

Every figure follows from the wire: characters at the line's speed, two gaps and the device's turnaround
a transaction. The turnaround is not documented; `TURNAROUND_S` is assumed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from gateway.core.settings import LineSettings, UpstreamSettings
from gateway.devices.model import DeviceMap, PollClass, Space
from gateway.devices.plan import poll_plan
from gateway.modbus.quarantine import MAX_WINDOW_S
from gateway.modbus.rtu import Timing

TURNAROUND_S = 0.015
REQUEST_BYTES = 8
REPLY_OVERHEAD_BYTES = 5
LONGEST_FRAME_BYTES = 256
UPSTREAM_BYTE_S = 1e-5
GRACE_S = 1.0
"""How long an upstream's line stays open without a connection."""
WATCH_S = 1.0
"""A face looks so often for requests that nobody has answered."""


@dataclass(frozen=True, slots=True)
class LineBudget:
    """Projection for one line. `use_ratio` over 1 means that periods stretch by that factor.

    What an upstream carries is not known beforehand: its `use_ratio` is None and the refresh times are those asked for.
    """

    use_ratio: float | None
    live_refresh_s: float  # how often each device's live values will be read
    settings_refresh_s: float
    reply_deadline_s: float  # a Modbus TCP client has its answer by then, or its connection is closed


def line_budget(settings: LineSettings, maps: Sequence[DeviceMap], *, timeouts_s: Sequence[float] = ()) -> LineBudget:
    """Project the use of a line whose devices have these maps (one map a device).

    `timeouts_s` are the time-outs of the devices that have one of their own.
    """
    if settings.upstream is not None:
        return _upstream_budget(settings, settings.upstream, timeouts_s)
    timing = settings.timing()
    period_s = {PollClass.LIVE: settings.poll.live_s, PollClass.SETTINGS: settings.poll.settings_s}
    use = sum(
        read_s(timing, block.space, block.count) / period_s[block.poll]
        for device_map in maps
        for block in poll_plan(device_map)
    )
    stretch = max(1.0, use)
    attempt_s = (
        timing.wire_s(REQUEST_BYTES)
        + max((settings.reply_timeout_s, *timeouts_s))
        + timing.wire_s(LONGEST_FRAME_BYTES)
        + max(settings.quarantine_s, MAX_WINDOW_S)  # late replies widen it (modbus/quarantine.py)
        + timing.gap_s
    )
    return LineBudget(
        use_ratio=use,
        live_refresh_s=settings.poll.live_s * stretch,
        settings_refresh_s=settings.poll.settings_s * stretch,
        # One transaction may be under way when the queue time ends; before each try there may be a settling question.
        reply_deadline_s=settings.queue_limit_s + (2 * (settings.retries + 1) + 1) * attempt_s + WATCH_S,
    )


def _upstream_budget(settings: LineSettings, upstream: UpstreamSettings, timeouts_s: Sequence[float]) -> LineBudget:
    timeout_s = max((settings.reply_timeout_s, *timeouts_s))
    # A try that fails in company waits for another that is made again alone, then is made again itself
    # (core/set_aside.py); before it there may be a settling question, and a new connection.
    attempt_s = 4 * timeout_s + min(upstream.connect_timeout_s, GRACE_S)
    return LineBudget(
        use_ratio=None,
        live_refresh_s=settings.poll.live_s,
        settings_refresh_s=settings.poll.settings_s,
        # As many tries, and whatever was under way when the queue time ended.
        reply_deadline_s=settings.queue_limit_s + (settings.retries + 2) * attempt_s + WATCH_S,
    )


def read_cost(settings: LineSettings) -> Callable[[Space, int], float]:
    """What one read costs of the line's time, in seconds; of an upstream only how reads compare with each other."""
    if settings.upstream is not None:
        return _upstream_read_s
    timing = settings.timing()
    return lambda space, count: read_s(timing, space, count)


def _upstream_read_s(space: Space, count: int) -> float:
    """Only the data count, so that reads are joined where they overlap, and holes between them are not read.

    What is read without being asked for may lie in two blocks of the upstream's memory, and so have to be fetched.
    """
    return (2 * count if space is Space.REGISTERS else (count + 7) // 8) * UPSTREAM_BYTE_S


def read_s(timing: Timing, space: Space, count: int) -> float:
    """Seconds of line time that one read of `count` registers or coils costs."""
    payload = 2 * count if space is Space.REGISTERS else (count + 7) // 8
    wire_s = timing.wire_s(REQUEST_BYTES) + timing.wire_s(REPLY_OVERHEAD_BYTES + payload)
    return wire_s + 2 * timing.gap_s + TURNAROUND_S
