"""What the log is told of a line and its devices: changes, and nothing twice."""

from __future__ import annotations

import logging

from gateway.core.site import Device
from gateway.core.snapshot import DeviceState

log = logging.getLogger(__name__)

STOPPING = "stopping"
"""Why a device is stale when its line is stopped in order: nobody has to be warned of that."""


class LineNews:
    """The news of one line; `quarantine_s` is what is configured."""

    def __init__(self, line: str, quarantine_s: float) -> None:
        self._line = line
        self._seen_s = self._calm_s = quarantine_s

    def quarantine(self, quarantine_s: float) -> None:
        """Say that late replies made the quarantine longer, and that it is as configured again."""
        if quarantine_s > self._seen_s:
            log.warning("event=late_replies line=%s quarantine_s=%g", self._line, quarantine_s)
        elif quarantine_s < self._seen_s and quarantine_s <= self._calm_s:
            log.info("event=late_replies_over line=%s quarantine_s=%g", self._line, quarantine_s)
        self._seen_s = quarantine_s

    def device(self, device: Device, before: DeviceState, lasted_s: float, reason: str) -> None:
        """Say that a device has another state than before, which lasted so long."""
        state = device.snapshot.state
        log.log(
            logging.INFO if state is DeviceState.ONLINE or reason == STOPPING else logging.WARNING,
            "event=device_%s line=%s device=%s address=%d before=%s lasted_s=%.1f%s",
            state,
            self._line,
            device.name,
            device.address,
            before,
            lasted_s,
            f' reason="{reason}"' if reason else "",
        )
