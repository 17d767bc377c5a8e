"""The gateway put together: lines, devices, faces, history, one supervisor.

Nothing is opened while it is built; a mistake here is a bad configuration or a bug, never a busy port. Its life
from start to signal is service/process.py's.
"""

from __future__ import annotations

import asyncio
from dataclasses import asdict

from gateway.clock import Clock
from gateway.core.site import Site
from gateway.core.stats import HistoryStats, ModbusServerStats
from gateway.faces.http.app import HttpFace
from gateway.faces.modbus.server import ModbusServer
from gateway.faces.snmp.agent import SnmpAgent
from gateway.history.keeper import HistoryKeeper
from gateway.history.source import HistorySource
from gateway.lines.serial import SerialLine
from gateway.service.conditions import ConditionKeeper
from gateway.service.config import Config
from gateway.service.parts import Listener, Runnable
from gateway.service.settings import (
    history_settings,
    http_settings,
    line_devices,
    line_settings,
    modbus_settings,
)
from gateway.service.snmp import snmp_settings
from gateway.service.supervisor import Supervisor
from gateway.service.systemd import Systemd
from gateway.service.watchdog import Watchdog


class Gateway:
    """All parts of one configuration."""

    def __init__(self, config: Config, clock: Clock, systemd: Systemd | None = None) -> None:
        groups = [line_devices(line) for line in config.line]
        self.lines = tuple(
            SerialLine(settings, devices, clock)
            for settings, devices in zip(line_settings(config), groups, strict=True)
        )
        self.site = Site.of(config.site, self.lines, [device for group in groups for device in group])
        stats = ModbusServerStats()
        self._modbus = modbus = ModbusServer(modbus_settings(config), self.site, clock, stats)
        history = HistoryStats() if config.history.enabled else None
        kept = history_settings(config)
        watching = ConditionKeeper(
            self.site, clock, not_ready=self.not_ready, history=history, state_dir=kept.directory
        )
        self.conditions = watching.conditions
        snmp = SnmpAgent(snmp_settings(config), self.site, clock, stats, conditions=self.conditions)
        http = HttpFace(
            http_settings(config),
            self.site,
            clock,
            modbus=stats,
            snmp=lambda: asdict(snmp.counters),
            not_ready=self.not_ready,
            history=history,
            log=None if history is None else HistorySource(kept.directory, config.site),
            clients=modbus.clients,
            conditions=self.conditions,
            notifications=snmp.notifier.stats,
        )
        harvesting = () if history is None else (HistoryKeeper(kept, self.site, clock, history),)
        watching.told = snmp.notifier.changed
        notifying = (snmp.notifier,) if snmp.notifier.stats else ()
        self.keepers: tuple[Runnable, ...] = (watching, *harvesting, *notifying)
        if systemd is not None and systemd.watchdog_s is not None:
            self.keepers += (Watchdog(systemd, systemd.watchdog_s, self.stuck),)
        self.listeners: tuple[Listener, ...] = (*modbus.listeners, *snmp.listeners, *http.listeners)
        self.supervisor = Supervisor(clock, self.lines, self.listeners, self.keepers)

    def not_ready(self) -> tuple[str, ...]:
        """Why the gateway does not do what its configuration says: listeners not open, files that cannot be used."""
        closed = tuple(f"{label} is not open" for label in self.supervisor.down())
        tls = self._modbus.stats.tls
        return (
            closed if tls is None or not tls.problem else (*closed, f"modbus tls cannot use its files: {tls.problem}")
        )

    def stuck(self, most_s: float) -> tuple[str, ...]:
        """See `Supervisor.stuck`."""
        return self.supervisor.stuck(most_s)

    def reload(self) -> None:
        """Take certificates, keys and CRLs as they are on disk now, or keep the old ones."""
        if self._modbus.door is not None:
            self._modbus.door.reload()

    async def run(self, stop: asyncio.Event) -> None:
        """Work until `stop` is set."""
        await self.supervisor.run(stop)
