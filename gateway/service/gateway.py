"""The gateway put together: lines, devices, faces, history, one supervisor; and put together anew at work.

Nothing is opened while it is built; a mistake here is a bad configuration or a bug, never a busy port. Its life
from start to signal is service/process.py's; how it comes to another configuration, service/reload.py's.
"""

from __future__ import annotations

import asyncio
import ssl
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

from gateway.clock import Clock
from gateway.core.conditions import Conditions, Watch
from gateway.core.site import LineState, Site
from gateway.core.snapshot import DeviceState
from gateway.core.stats import HistoryStats, ModbusServerStats, ServiceStats
from gateway.errors import ConfigError, ListenError, TlsFilesError
from gateway.faces.http.access import Access, tls_context
from gateway.faces.http.app import HttpFace
from gateway.faces.modbus.server import ModbusServer
from gateway.faces.snmp.agent import SnmpAgent
from gateway.faces.snmp.log_keeper import LogKeeper
from gateway.faces.snmp.settings import SnmpSettings
from gateway.history.keeper import HistoryKeeper
from gateway.history.session import Session
from gateway.history.source import HistorySource
from gateway.lines.factory import Line
from gateway.service.conditions import ConditionKeeper
from gateway.service.models import ModelKeeper
from gateway.service.parts import Listener, Runnable
from gateway.service.settings import history_settings, http_settings, line_sites, modbus_settings
from gateway.service.snmp import snmp_settings
from gateway.service.south import South
from gateway.service.supervisor import Supervisor
from gateway.service.systemd import Systemd
from gateway.service.tls import read_files, tls_settings
from gateway.service.tracing import Tracer
from gateway.service.watchdog import Watchdog

if TYPE_CHECKING:
    from gateway.faces.modbus.tls_files import Credentials
    from gateway.service.schema import Config


@dataclass(frozen=True, slots=True)
class Plan:
    """Another configuration, read, checked and built."""

    config: Config
    south: South
    conditions: Conditions
    history: HistoryStats | None
    snmp: SnmpAgent | None  # None: as before
    days: LogKeeper | None  # what fills the agent's log table
    access: Access
    https: ssl.SSLContext | None  # None: as before
    tls: Credentials | None


class Gateway:
    """All parts of one configuration, and of the next."""

    def __init__(self, config: Config, clock: Clock, systemd: Systemd | None = None) -> None:
        self.config = config
        self._clock = clock
        self._south = south = South.of(config, clock)
        self.stats = ServiceStats(configured_at=clock.monotonic())
        self._modbus_stats = ModbusServerStats()
        self._modbus = ModbusServer(modbus_settings(config), self.site, clock, self._modbus_stats)
        self._history = HistoryStats() if config.history.enabled else None
        self._history_session = Session.begin(clock)
        kept = history_settings(config)
        self._watching = ConditionKeeper(
            self.site, clock, not_ready=self.not_ready, history=self._history, state_dir=kept.directory
        )
        self._snmp_settings = snmp_settings(config)
        self._days: LogKeeper | None = None
        self._days = self._log_keeper(self._snmp_settings, config, self.site, self._history)
        self._snmp = self._agent(self._snmp_settings, self.site, self._watching.conditions, self._days)
        self._http = HttpFace(
            http_settings(config),
            self.site,
            clock,
            modbus=self._modbus_stats,
            snmp=lambda: asdict(self._snmp.counters),
            not_ready=self.not_ready,
            history=self._history,
            log=self._log(config),
            clients=self._modbus.clients,
            conditions=self.conditions,
            notifications=self._snmp.notifier.stats,
            service=self.stats,
        )
        self._watching.told = self._tell
        self._harvesting = self._harvester(config, self.site)
        self._others: tuple[Runnable, ...] = (Tracer(kept.directory, lambda: self.lines, clock),)
        if systemd is not None and systemd.watchdog_s is not None:
            self._others += (Watchdog(systemd, systemd.watchdog_s, self.stuck, self.summary),)
        self.changing = asyncio.Lock()  # held from the plan of a change to its end
        self._models = ModelKeeper(lambda: self.site, self.show_models)
        self.supervisor = Supervisor(clock, south.lines, self.listeners, self.keepers)
        self.stats.restarts = self.supervisor.restarts

    async def show_models(self) -> None:
        """Show each device by the map that it has by now: the faces are put together anew, and nothing else."""
        async with self.changing:
            south = South.of(self.config, self._clock, self._south)
            now = self._clock.monotonic()
            conditions = ConditionKeeper.of(south.site, self._history, now, self.conditions)
            settings, history = self._snmp_settings, self._history
            days = self._log_keeper(settings, self.config, south.site, history)
            agent = await asyncio.to_thread(self._agent, settings, south.site, conditions, days, self._snmp)
            access = self._http.access
            await self.change(Plan(self.config, south, conditions, history, agent, days, access, https=None, tls=None))

    @property
    def lines(self) -> tuple[Line, ...]:
        """The lines, in the order of the file."""
        return self._south.lines

    @property
    def site(self) -> Site:
        """Lines and devices as the faces see them."""
        return self._south.site

    @property
    def conditions(self) -> Conditions:
        """Everything that can be wrong."""
        return self._watching.conditions

    @property
    def listeners(self) -> tuple[Listener, ...]:
        """Every address of every face."""
        return (*self._modbus.listeners, *self._snmp.listeners, *self._http.listeners)

    @property
    def keepers(self) -> tuple[Runnable, ...]:
        """What runs beside lines and listeners."""
        notifier = self._snmp.notifier
        finding = (self._models,) if any(device.auto for device in self.site.devices) else ()
        days = () if self._days is None else (self._days,)
        telling = (notifier,) if notifier.stats else ()
        return (self._watching, *finding, *self._harvesting, *telling, *days, *self._others)

    def keep(self, keeper: Runnable) -> None:
        """Have one more keeper; before `run`."""
        self._others += (keeper,)
        self.supervisor.keep(keeper)

    def not_ready(self) -> tuple[str, ...]:
        """Why the gateway does not do what its configuration says: listeners not open, files that cannot be used."""
        closed = tuple(f"{label} is not open" for label in self.supervisor.down())
        tls = self._modbus.stats.tls
        return (
            closed if tls is None or not tls.problem else (*closed, f"modbus tls cannot use its files: {tls.problem}")
        )

    def summary(self) -> str:
        """How things stand, in one line for people."""
        now, devices, lines = self._clock.monotonic(), self.site.devices, self.site.lines
        online = sum(device.snapshot.state is DeviceState.ONLINE for device in devices)
        down = sum(line.status(now).state is LineState.DOWN for line in lines)
        closed = len(self.supervisor.down())
        said = [f"{online} of {len(devices)} controllers online"]
        if down:
            said.append(f"{down} of {len(lines)} lines down")
        if closed:
            said.append(f"{closed} of {len(self.listeners)} listeners not open")
        if not self.stats.reload_works:
            said.append("the configuration was refused, the one before it is in use")
        return "; ".join(said)

    def stuck(self, most_s: float) -> tuple[str, ...]:
        """See `Supervisor.stuck`."""
        return self.supervisor.stuck(most_s)

    async def run(self, stop: asyncio.Event) -> None:
        """Work until `stop` is set."""
        await self.supervisor.run(stop)

    async def plan(self, config: Config) -> Plan:
        """Build what another configuration wants; nothing is touched. ConfigError when it cannot be had."""
        south = await asyncio.to_thread(South.of, config, self._clock, self._south)
        history = (self._history or HistoryStats()) if config.history.enabled else None
        if history is not None and south.site is not self.site:
            history = history.of(south.unchanged(self._south))
        conditions = self.conditions
        if south.site is not self.site or (history is None) is not (self._history is None):
            conditions = ConditionKeeper.of(south.site, history, self._clock.monotonic(), conditions)
        return await asyncio.to_thread(self._plan, config, south, history, conditions)

    def _plan(self, config: Config, south: South, history: HistoryStats | None, conditions: Conditions) -> Plan:
        problems: list[str] = []
        access, https, tls, agent, days = Access(), None, None, None, self._days
        try:
            access = Access.read(http_settings(config))
            https = tls_context(http_settings(config))
        except ListenError as error:
            problems.append(f"http: {error}")
        tls_wanted = tls_settings(config)
        try:
            tls = None if tls_wanted is None else read_files(tls_wanted, self._clock.wall())
        except TlsFilesError as error:
            self._modbus.files_unusable(str(error))
            problems += [f"modbus.tls.{key}: {text}" for key, text in error.problems]
        try:
            settings = snmp_settings(config)
        except ConfigError as error:
            raise ConfigError((*problems, *error.problems)) from None
        if problems:
            raise ConfigError(tuple(problems))
        if settings != self._snmp_settings or conditions is not self.conditions:
            days = self._log_keeper(settings, config, south.site, history)
            agent = self._agent(settings, south.site, conditions, days, self._snmp)
        return Plan(config, south, conditions, history, agent, days, access, https, tls)

    async def change(self, plan: Plan) -> None:
        """Come to another configuration: a step that nobody sees half of; then what goes stops, what comes is tried."""
        config, south = plan.config, plan.south
        before, self._south = self._south, south
        same_log = config.history == self.config.history and south.site is before.site
        self.config, self._history = config, plan.history
        south.adjust_lines(before)
        self._watching.adjust(plan.conditions, plan.history)
        self._modbus.adjust(modbus_settings(config), south.site, plan.tls)
        if plan.snmp is not None:
            self._snmp_settings, self._days = plan.snmp.settings, plan.days
            self._snmp.adjust(plan.snmp)
            self._snmp.notifier.go_on(plan.conditions)
            self._tell(tuple(plan.conditions.active()), self._clock.monotonic())  # receivers that are new know nothing
        self._http.adjust(
            http_settings(config),
            plan.access,
            south.site,
            tls=plan.https,
            history=plan.history,
            log=self._log(config),
            conditions=plan.conditions,
            notifications=self._snmp.notifier.stats,
        )
        if not same_log:
            self._harvesting = self._harvester(config, south.site)
        await self.supervisor.change(south.lines, self.listeners, self.keepers)
        await self.supervisor.settled()

    def _tell(self, watches: Sequence[Watch], now: float) -> None:
        self._snmp.notifier.changed(watches, now)

    def _agent(
        self,
        settings: SnmpSettings,
        site: Site,
        conditions: Conditions,
        days: LogKeeper | None,
        before: SnmpAgent | None = None,
    ) -> SnmpAgent:
        return SnmpAgent(
            settings,
            site,
            self._clock,
            self._modbus_stats,
            conditions=conditions,
            clients=self._modbus.clients,
            days=None if days is None else days.days,
            before=before,
            give_way=self._modbus.hub.serve,
        )

    def _log_keeper(
        self, settings: SnmpSettings, config: Config, site: Site, history: HistoryStats | None
    ) -> LogKeeper | None:
        """What fills the log table, where there is one."""
        source = self._log(config)
        if source is None or history is None or not settings.log_table or not (settings.communities or settings.users):
            return None
        if self._days is not None and self._days.fits(site, history):
            return self._days  # an agent for other users shows what is there, and not an empty table until it is read
        return LogKeeper(site, source, history)

    def _log(self, config: Config) -> HistorySource | None:
        if not config.history.enabled:
            return None
        return HistorySource(history_settings(config).directory, config.site, line_sites(config))

    def _harvester(self, config: Config, site: Site) -> tuple[HistoryKeeper, ...]:
        if self._history is None:
            return ()
        settings, session = history_settings(config), self._history_session
        return (HistoryKeeper(settings, site, self._clock, self._history, session=session),)
