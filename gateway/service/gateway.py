"""The gateway put together: lines, devices, faces, history, one supervisor; and its life from start to signal.

Rule 1: nothing is opened while it is built; a mistake here is a bad configuration or a bug, never a busy port.
Rule 2: the first SIGTERM or SIGINT stops in order (service/supervisor.py), the second ends the process at once.
        Both leave exit status 0.
Rule 3: SIGHUP has the files of Modbus/TCP Security read again (faces/modbus/tls.py). The configuration is read once.
"""

from __future__ import annotations

import asyncio
import logging
import os
import signal
from collections.abc import Callable
from dataclasses import asdict

from gateway import __version__
from gateway.clock import Clock, SystemClock
from gateway.core.site import Site
from gateway.core.stats import HistoryStats, ModbusServerStats
from gateway.faces.http.app import HttpFace
from gateway.faces.modbus.server import ModbusServer
from gateway.faces.snmp.agent import SnmpAgent
from gateway.history.keeper import HistoryKeeper
from gateway.history.source import HistorySource
from gateway.lines.serial import SerialLine
from gateway.service.advice import advice
from gateway.service.conditions import ConditionKeeper
from gateway.service.config import Config
from gateway.service.settings import (
    history_settings,
    http_settings,
    line_budgets,
    line_devices,
    line_settings,
    modbus_settings,
)
from gateway.service.snmp import snmp_settings
from gateway.service.supervisor import Listener, Runnable, Supervisor

_log = logging.getLogger(__name__)


class Gateway:
    """All parts of one configuration."""

    def __init__(self, config: Config, clock: Clock) -> None:
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
        )
        harvesting = () if history is None else (HistoryKeeper(kept, self.site, clock, history),)
        self.keepers: tuple[Runnable, ...] = (watching, *harvesting)
        self.listeners: tuple[Listener, ...] = (*modbus.listeners, *snmp.listeners, *http.listeners)
        self.supervisor = Supervisor(clock, self.lines, self.listeners, self.keepers)

    def not_ready(self) -> tuple[str, ...]:
        """Why the gateway does not do what its configuration says: listeners not open, files that cannot be used."""
        closed = tuple(f"{label} is not open" for label in self.supervisor.down())
        tls = self._modbus.stats.tls
        return (
            closed if tls is None or not tls.problem else (*closed, f"modbus tls cannot use its files: {tls.problem}")
        )

    def reload(self) -> None:
        """Take certificates, keys and CRLs as they are on disk now, or keep the old ones."""
        if self._modbus.door is not None:
            self._modbus.door.reload()

    async def run(self, stop: asyncio.Event) -> None:
        """Work until `stop` is set."""
        await self.supervisor.run(stop)


def serve(config: Config, make_loop: Callable[[], asyncio.AbstractEventLoop]) -> None:
    """Run the gateway until a signal stops it."""
    with asyncio.Runner(loop_factory=make_loop) as runner:
        runner.run(_serve(config))


async def _serve(config: Config) -> None:
    running = asyncio.get_running_loop()
    stop = asyncio.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        running.add_signal_handler(number, _stopper(number, stop))
    gateway = Gateway(config, SystemClock())
    running.add_signal_handler(signal.SIGHUP, gateway.reload)
    for text in advice(config, line_budgets(config)):
        _log.warning('event=advice text="%s"', text.replace('"', "'"))
    _log.info(
        'event=started site="%s" version=%s lines=%d devices=%d loop=%s',
        config.site,
        __version__,
        len(gateway.lines),
        len(gateway.site.devices),
        type(running).__module__.partition(".")[0],
    )
    await gateway.run(stop)
    _log.info("event=stopped")


def _stopper(number: signal.Signals, stop: asyncio.Event) -> Callable[[], None]:
    def on_signal() -> None:
        if stop.is_set():
            logging.shutdown()
            os._exit(0)  # whoever signals twice does not want to wait for anything
        _log.info("event=stopping signal=%s", number.name)
        stop.set()

    return on_signal
