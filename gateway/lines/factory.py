"""The line that suits its settings."""

from __future__ import annotations

from collections.abc import Sequence

from gateway.clock import Clock
from gateway.core.settings import LineSettings
from gateway.core.site import Device
from gateway.lines.serial import SerialLine
from gateway.lines.upstream import UpstreamLine

Line = SerialLine | UpstreamLine


def make_line(settings: LineSettings, devices: Sequence[Device], clock: Clock) -> Line:
    """A line with its devices, not yet running."""
    if settings.upstream is None:
        return SerialLine(settings, devices, clock)
    return UpstreamLine(settings, devices, clock)
