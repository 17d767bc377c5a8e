"""Metrics of the stored daily log: how it is kept, never the days themselves (those are exported, api.py)."""

from __future__ import annotations

from dataclasses import dataclass

from gateway.core.stats import DeviceHistoryStats, HistoryStats
from gateway.faces.http.devices import DEVICE_LABELS
from gateway.faces.http.rules import Rule, each, gateway_counter, gateway_gauge, known, one


@dataclass(frozen=True, slots=True)
class DeviceHistoryView:
    """The history of one device at the moment of a scrape (monotonic)."""

    stats: DeviceHistoryStats
    now: float

    @property
    def age_s(self) -> float | None:
        """Time since the last harvest."""
        at = self.stats.harvested_at
        return None if at is None else max(0.0, self.now - at)

    @property
    def wait_s(self) -> float:
        """How long a read has been waiting; 0 when none waits."""
        since = self.stats.waiting_since
        return 0.0 if since is None else max(0.0, self.now - since)


DEVICE_HISTORY_RULES: tuple[Rule[DeviceHistoryView], ...] = (
    known(
        gateway_gauge(
            "history_blocks", "Days (log blocks) stored of the controller that is there now.", *DEVICE_LABELS
        ),
        lambda view: view.stats.days,
    ),
    known(
        gateway_gauge(
            "history_blocks_apart",
            "Log blocks kept apart of the controller that is there now, because their hourmeter cannot be.",
            *DEVICE_LABELS,
        ),
        lambda view: view.stats.apart,
    ),
    known(
        gateway_gauge(
            "history_last_harvest_age_seconds",
            "Time since the daily log was last read to its end; absent until it was.",
            *DEVICE_LABELS,
        ),
        lambda view: view.age_s,
    ),
    one(
        gateway_gauge(
            "history_wait_seconds",
            "How long a read of the daily log has been waiting for idle time on its line; 0 while none waits.",
            *DEVICE_LABELS,
        ),
        lambda view: view.wait_s,
    ),
    one(
        gateway_counter("history_harvests", "How often the daily log was read to its end.", *DEVICE_LABELS),
        lambda view: view.stats.harvests,
    ),
    each(
        gateway_counter("history_failures", "Harvests that ended early, by reason.", *DEVICE_LABELS, "reason"),
        lambda view: view.stats.failures,
    ),
)

STORE_RULES: tuple[Rule[HistoryStats], ...] = (
    one(
        gateway_gauge("history_store_up", "1 while days can be stored, 0 while the disk or the file refuses."),
        lambda stats: stats.store_up,
    ),
    each(
        gateway_counter("history_store_errors", "Failures to open, read or write the file, by kind.", "kind"),
        lambda stats: stats.store_errors,
    ),
)
