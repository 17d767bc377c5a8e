"""The SNMP agent's sockets: UDP, IPv4 and IPv6, SNMPv2c, read-only.

A datagram is answered where it arrives, without a queue or a task: `responder.py` needs well under a millisecond and
never waits. The sockets are bound by ourselves, so that a taken port is an error with a name.
"""

from __future__ import annotations

import asyncio
import logging
import socket
from typing import cast

import gateway
from gateway.clock import Clock
from gateway.core.site import Site
from gateway.core.stats import ModbusServerStats
from gateway.errors import ListenError
from gateway.faces.snmp import standard
from gateway.faces.snmp.access import Access, source_address
from gateway.faces.snmp.counters import SnmpCounters
from gateway.faces.snmp.layout import Layout, shipped_layout
from gateway.faces.snmp.objects import Gateway
from gateway.faces.snmp.responder import Refused, Responder
from gateway.faces.snmp.settings import SnmpSettings
from gateway.faces.snmp.throttle import Throttle
from gateway.faces.snmp.tree import Tree, whole

_log = logging.getLogger(__name__)


class SnmpAgent:
    """The SNMP face: one tree, one set of communities, any number of listeners.

    `counters` tells what was asked, `layout` what there is. sysUpTime counts from the construction.
    """

    def __init__(self, settings: SnmpSettings, site: Site, clock: Clock, modbus: ModbusServerStats) -> None:
        self.counters = SnmpCounters()
        self.layout: Layout = shipped_layout(settings.enterprise_root)
        self._clock = clock
        described = Gateway(
            site=site,
            version=gateway.__version__,
            started_at=clock.monotonic(),
            modbus=modbus,
            snmp=self.counters,
            contact=settings.contact,
            location=settings.location,
            object_id=self.layout.product,
            capabilities=(
                (standard.SNMP_MIB, "SNMPv2-MIB: the system and snmp groups, read-only"),
                (self.layout.module, "PROSTAR-GATEWAY-MIB: gateway, lines and solar charge controllers"),
            ),
        )
        self.tree: Tree = whole(self.layout, described, standard.GROUPS, (standard.CAPABILITIES,))
        self._responder = Responder(Access(settings.communities), self.tree, self.counters)
        self._throttle = Throttle()
        self.listeners = tuple(SnmpListener(self, host, port) for host, port in settings.listen)
        self._warm_up()

    def answer(self, data: bytes, host: str) -> bytes | None:
        """The reply to a datagram from `host`, or None; never raises."""
        now = self._clock.monotonic()
        try:
            return self._responder.answer(data, source_address(host), now)
        except Refused as refused:
            count = self._throttle.due(refused.refusal.value, now)
            if count:
                _log.warning("snmp_dropped reason=%s source=%s count=%d", refused.refusal.value, host, count)
        except Exception:  # noqa: BLE001 - the datagram edge: whatever one datagram does, the next one is served
            self.counters.internal_errors += 1
            _log.exception("snmp_internal_error source=%s", host)
        return None

    def _warm_up(self) -> None:
        """Encode every cell and answer every kind of request once, so that no first request waits for it."""
        now = self._clock.monotonic()
        for slot in self.tree:
            slot.varbind(now)
        self._responder.rehearse(now)


class _Endpoint(asyncio.DatagramProtocol):
    """Five moves between socket and agent."""

    def __init__(self, agent: SnmpAgent, label: str) -> None:
        self._agent = agent
        self._label = label
        self._transport: asyncio.DatagramTransport | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast("asyncio.DatagramTransport", transport)

    def datagram_received(self, data: bytes, addr: tuple[str, int]) -> None:
        reply = self._agent.answer(data, addr[0])
        if reply is not None and self._transport is not None:
            self._transport.sendto(reply, addr)

    def error_received(self, exc: Exception) -> None:
        # An asker that is gone by now (ICMP port unreachable); nothing of ours is wrong.
        _log.debug("snmp_send_failed listener=%s reason=%s", self._label, exc)


class SnmpListener:
    """One bound UDP socket of the agent; `start` may be tried again after a failure, or after `stop`."""

    def __init__(self, agent: SnmpAgent, host: str, port: int) -> None:
        self._agent = agent
        self._host = host
        self._port = port
        shown = f"[{host}]" if ":" in host else host
        self.label = f"snmp {shown}:{port}"
        self._transport: asyncio.DatagramTransport | None = None

    @property
    def bound(self) -> tuple[str, int] | None:
        """Address and port after `start`, None while not listening."""
        if self._transport is None:
            return None
        name = self._transport.get_extra_info("sockname")
        return name[0], name[1]

    async def start(self) -> None:
        """Bind and serve; raises ListenError, which names address and reason, and leaves nothing open."""
        if self._transport is not None:
            return
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
            self._transport, _ = await loop.create_datagram_endpoint(
                lambda: _Endpoint(self._agent, self.label), sock=sock
            )
        except OSError as error:
            if sock is not None:
                sock.close()
            raise ListenError(f"{self.label} (UDP): {error.strerror or error}") from error

    async def stop(self) -> None:
        """Close the socket; a listener that is not started stays so."""
        transport, self._transport = self._transport, None
        if transport is not None:
            transport.close()
