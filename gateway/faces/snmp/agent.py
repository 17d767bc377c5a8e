"""The SNMP agent's sockets: UDP, IPv4 and IPv6; SNMPv1, v2c and v3; read-only.

1. A datagram is answered where it arrives, without a queue or a task: `responder.py` never waits. Those that wait in
   the socket are answered together, for at most TURN_S; then the others of the event loop have their turn. Modbus
   clients have it every SHARE_S (`give_way`).
2. The sockets are bound by ourselves, so that a taken port is an error with a name. Before the first of them is bound,
   the boots of this start are on disk (`engine.py`). What listens everywhere answers from where it was asked
   (`datagrams.py`).
"""

from __future__ import annotations

import asyncio
import logging
import socket
from collections.abc import Callable, Iterable, Mapping
from functools import partial

import gateway
from gateway.clock import Clock
from gateway.core.clients import Client
from gateway.core.conditions import Conditions
from gateway.core.site import Site
from gateway.core.stats import ModbusServerStats
from gateway.errors import ListenError
from gateway.faces.binding import bind_problem
from gateway.faces.snmp import entity, standard
from gateway.faces.snmp.client_rows import ClientRows
from gateway.faces.snmp.counters import SnmpCounters
from gateway.faces.snmp.datagrams import Datagrams, datagrams
from gateway.faces.snmp.emc1 import context_of, emc1_tree
from gateway.faces.snmp.engine import Engine, EngineLost, start_engine
from gateway.faces.snmp.layout import Layout, shipped_layout
from gateway.faces.snmp.log_table import LogDays
from gateway.faces.snmp.notifier import Notifier
from gateway.faces.snmp.objects import Gateway, ticks_since
from gateway.faces.snmp.responder import DATAGRAM_LIMIT, Refused, Responder
from gateway.faces.snmp.security import Security
from gateway.faces.snmp.settings import SnmpSettings
from gateway.faces.snmp.throttle import Throttle
from gateway.faces.snmp.tree import Tree, whole

_log = logging.getLogger(__name__)


TURN_S = 0.001
"""How long waiting datagrams are answered in one go; the one under way then is finished."""

SHARE_S = 0.00005
"""How long they are answered before `give_way`; the run or the one under way then is finished."""


class SnmpAgent:
    """The SNMP face: the trees of one gateway, one set of credentials, any number of listeners.

    `counters` tells what was asked, `layout` what there is. sysUpTime counts from the construction.
    """

    def __init__(
        self,
        settings: SnmpSettings,
        site: Site,
        clock: Clock,
        modbus: ModbusServerStats,
        *,
        conditions: Conditions | None = None,
        clients: Iterable[Client] = (),
        days: LogDays | None = None,
        before: SnmpAgent | None = None,
        give_way: Callable[[], None] = lambda: None,
    ) -> None:
        """Without `conditions` of somebody who tells them of the gateway, those of lines and devices are shown.

        `clients` are those of the Modbus TCP face at any moment, `days` the log table; without it there is none.
        `give_way` serves those who must not wait for a turn of this face to end; it is called every SHARE_S of it.
        With `before` it is made to be given to that one's `adjust`: same counters, same engine, same uptime.
        """
        self.counters: SnmpCounters = SnmpCounters() if before is None else before.counters
        self.started_at: float = clock.monotonic() if before is None else before.started_at
        self.layout: Layout = shipped_layout(settings.enterprise_root)
        self.settings = settings
        self._clock = clock
        self._give_way = give_way
        self._share_ends_at = 0.0
        self._engine: Engine | None = None if before is None else before._engine  # noqa: SLF001 - its own kind
        described = Gateway(
            site=site,
            version=gateway.__version__,
            started_at=self.started_at,
            modbus=modbus,
            snmp=self.counters,
            contact=settings.contact,
            location=settings.location,
            object_id=self.layout.product,
            capabilities=(
                (standard.SNMP_MIB, "SNMPv2-MIB: the system and snmp groups, read-only"),
                (self.layout.module, "PROSTAR-GATEWAY-MIB: gateway, lines and solar charge controllers"),
                *entity.CAPABILITIES,
            ),
            authentication_traps=settings.authentication_traps,
            clients=ClientRows(clients),
            conditions=conditions if conditions is not None else Conditions(site, (), clock.monotonic()),
        )
        groups = (*standard.GROUPS, entity.GENERAL)
        self.tree: Tree = whole(self.layout, described, groups, (standard.CAPABILITIES, *entity.TABLES), days)
        contexts: Mapping[bytes, Tree] = {b"": self.tree} | {
            context_of(each.unit_id): emc1_tree(described, site.by_unit[each.unit_id]) for each in settings.emc1
        }
        self._trees = tuple(contexts.values())
        self._responder = Responder(settings, contexts, self.counters)
        self._throttle = Throttle()
        self._site_name = site.name
        self._ticks = partial(ticks_since, self.started_at)  # receivers that stay keep it, and no site with it
        self.notifier = self._new_notifier(None)
        self._listen_to_failures()
        self.listeners: tuple[SnmpListener, ...] = ()
        self.listeners = self._listeners()
        if before is None:
            self._warm_up()
        elif self._engine is not None:
            self.prepare()

    def adjust(self, fresh: SnmpAgent) -> None:
        """Go on as the agent that was made for it: with its settings and trees, as the same engine.

        `listeners` are those that are wanted then: the same ones where address and context are the same. `notifier`
        is another one only where its receivers or what they are told are others.
        """
        before = (self.settings.receivers, self.settings.enterprise_root, self._site_name)
        self.settings, self._site_name = fresh.settings, fresh._site_name
        self.layout, self.tree, self._trees = fresh.layout, fresh.tree, fresh._trees
        self._responder = fresh._responder
        if before != (self.settings.receivers, self.settings.enterprise_root, self._site_name):
            same = before[1:] == (self.settings.enterprise_root, self._site_name)
            self.notifier = self._new_notifier(self.notifier if same else None)
        self._listen_to_failures()
        self.listeners = self._listeners()
        if any(listener.bound for listener in self.listeners):
            self.prepare()

    def _new_notifier(self, before: Notifier | None) -> Notifier:
        return Notifier(
            self.settings.receivers,
            self.layout,
            site=self._site_name,
            clock=self._clock,
            engine=self.engine,
            ticks=self._ticks,
            before=before,
        )

    def _listen_to_failures(self) -> None:
        if self.settings.authentication_traps:
            self._responder.on_authentication_failure = self.notifier.authentication_failed

    def _listeners(self) -> tuple[SnmpListener, ...]:
        """The listeners of the settings; those that there are already are taken."""
        settings = self.settings
        wanted = [SnmpListener(self, host, port) for host, port in settings.listen]
        for each in settings.emc1:
            wanted += [SnmpListener(self, host, port, context_of(each.unit_id)) for host, port in each.listen]
        present = {listener.label: listener for listener in self.listeners}
        return tuple(present.get(listener.label, listener) for listener in wanted)

    def engine(self) -> Engine:
        """The SNMPv3 engine of this start; the first call writes its boots. EngineLost when there can be none."""
        if self._engine is None:
            settings = self.settings
            enterprise = settings.enterprise_root[6]
            now = self._clock.monotonic()
            self._engine = start_engine(settings.state_dir, enterprise, now, renew=settings.renew_engine)
        return self._engine

    def prepare(self) -> None:
        """Make SNMPv3 ready where there are users: before a socket is bound, and once."""
        users = self.settings.users
        if not users or self._responder.security is not None:
            return
        try:
            engine = self.engine()
        except EngineLost as error:
            _log.error('event=snmp_v3_off reason="%s"', error)
            return
        self._responder.security = Security(
            engine, [user.credentials for user in users], self.counters, self.settings.reply_octets
        )
        _log.info("event=snmp_v3_on engine_id=%s boots=%d users=%d", engine.engine_id.hex(), engine.boots, len(users))

    def answer(self, data: bytes, host: str, context: bytes = b"") -> bytes | None:
        """What goes back for a datagram from `host`, or None; never raises. `context` is that of the listener."""
        now = self._clock.monotonic()
        try:
            return self._responder.answer(data, host, now, context)
        except Refused as refused:
            label = refused.refusal.label
            count = self._throttle.due(label, now)
            if count:
                _log.warning("event=snmp_dropped reason=%s source=%s count=%d", label, host, count)
            return refused.report or None
        except Exception:  # noqa: BLE001 - the datagram edge: whatever one datagram does, the next one is served
            self.counters.internal_errors += 1
            count = self._throttle.due("internal_error", now)
            if count:
                _log.exception("event=snmp_internal_error source=%s count=%d", host, count)
        return None

    def answer_waiting(self, sock: Datagrams, context: bytes = b"") -> None:
        """Answer what waits in the socket, for one turn."""
        quick, monotonic, receive, send = (
            self._responder.quick.answer,
            self._clock.monotonic,
            sock.recvfrom,
            sock.sendto,
        )
        now = self._begin()
        until, share = now + TURN_S, now + SHARE_S
        while True:
            try:
                unknown = receive(DATAGRAM_LIMIT + 1) if context else quick(receive, send)
            except (BlockingIOError, InterruptedError):
                break
            except OSError as error:
                # An asker that is gone by now (ICMP port unreachable); nothing of ours is wrong.
                _log.debug("event=snmp_receive_failed reason=%s", error)
                continue
            if unknown is not None:
                data, address = unknown
                reply = self._reply(data, address[0], context, now)
                if reply is not None:
                    try:
                        send(reply, address)
                    except OSError:
                        self.counters.send_failures += 1
            now = monotonic()
            if now >= share:
                self._give_way()
                now = monotonic()
                if now >= until:
                    break
                share = now + SHARE_S
        self._share_ends_at = share

    def _reply(self, data: bytes, host: str, context: bytes, now: float) -> bytes | None:
        """As `answer`, from what is kept where there is something."""
        reply = None if context else self._responder.again(data, host, now)
        if reply is None:
            return self.answer(data, host, context)
        self.counters.in_packets += 1
        self.counters.responses += 1
        return reply

    def _begin(self) -> float:
        """When a turn begins: others had the loop meanwhile, and took as long as they took."""
        now = self._clock.monotonic()
        if now < self._share_ends_at:
            return now
        self._give_way()
        return self._clock.monotonic()

    def _warm_up(self) -> None:
        """Encode a cell of every column and answer every kind of request once, so that no first one waits for it."""
        now = self._clock.monotonic()
        for tree in self._trees:
            for column in tree.columns:
                column.varbind(0, now)
        self._responder.rehearse(now)


class SnmpListener:
    """One bound UDP socket of the agent; `start` may be tried again after a failure, or after `stop`.

    What comes here is about `context` unless it asks for another one.
    """

    def __init__(self, agent: SnmpAgent, host: str, port: int, context: bytes = b"") -> None:
        self._agent = agent
        self._context = context
        self._host = host
        self._port = port
        shown = f"[{host}]" if ":" in host else host
        self.label = f"snmp{f' for unit {context.decode()}' if context else ''} {shown}:{port}"
        self._socket: socket.socket | None = None

    @property
    def bound(self) -> tuple[str, int] | None:
        """Address and port after `start`, None while not listening."""
        if self._socket is None:
            return None
        name = self._socket.getsockname()
        return name[0], name[1]

    async def start(self) -> None:
        """Bind and serve; raises ListenError, which names address and reason, and leaves nothing open."""
        if self._socket is not None:
            return
        self._agent.prepare()
        loop = asyncio.get_running_loop()
        sock: socket.socket | None = None
        try:
            found = await loop.getaddrinfo(
                self._host, self._port, type=socket.SOCK_DGRAM, flags=socket.AI_PASSIVE | socket.AI_NUMERICSERV
            )
            family, kind, protocol, _, address = found[0]
            sock = socket.socket(family, kind, protocol)
            sock.setblocking(False)  # noqa: FBT003 - its only parameter, and positional-only
            if family == socket.AF_INET6:
                # One socket, one family: [::] and 0.0.0.0 can both be listed.
                sock.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1)
            sock.bind(address)
            waiting = datagrams(sock)
        except OSError as error:
            if sock is not None:
                sock.close()
            raise ListenError(f"{self.label} (UDP): {bind_problem(error)}") from error
        self._socket = sock
        loop.add_reader(sock, self._agent.answer_waiting, waiting, self._context)

    async def stop(self) -> None:
        """Close the socket; a listener that is not started stays so."""
        sock, self._socket = self._socket, None
        if sock is not None:
            asyncio.get_running_loop().remove_reader(sock)
            sock.close()
