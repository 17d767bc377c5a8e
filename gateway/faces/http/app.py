"""The HTTP face: everything from memory but `/api/v1/log`, which is from the history.

`/metrics`, `/sd`, `/api/v1/clients` and `/api/v1/conditions` for programs, a page for people, `/healthz` and `/readyz`
for supervisors.
Nothing here reads a line or waits for one, whatever is asked. `/healthz` answers as long as the loop runs;
`/readyz` says whether the configuration is served as it stands, and is not about the controllers: one that
is dead is seen in `/metrics`.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace

from aiohttp import hdrs, web

from gateway.clock import Clock
from gateway.core.clients import Client
from gateway.core.conditions import Conditions
from gateway.core.daylog import DayLog
from gateway.core.site import Site
from gateway.core.stats import HistoryStats, ModbusServerStats, NotifyStats, ServiceStats
from gateway.faces.http import api
from gateway.faces.http import clients as client_list
from gateway.faces.http import conditions as condition_list
from gateway.faces.http.access import Access, guard
from gateway.faces.http.api import LogApi
from gateway.faces.http.discovery import targets
from gateway.faces.http.exposition import Exposition, compressed
from gateway.faces.http.listener import HttpListener
from gateway.faces.http.own import Counts, HttpStats
from gateway.faces.http.page import index_page
from gateway.faces.http.settings import HttpSettings
from gateway.faces.http.text import accepts_gzip, negotiate

_NO_STORE = {"Cache-Control": "no-store"}
_PAGE_HEADERS = {
    **_NO_STORE,
    "Content-Security-Policy": "default-src 'none'; style-src 'unsafe-inline'",
    "X-Content-Type-Options": "nosniff",
}


class HttpFace:
    """Metrics and health of one gateway.

    `modbus` and `snmp` are the counters of the other faces; `not_ready` gives the reasons why the gateway
    is not ready, none when it is; `history` and `log` are there where a history is kept; `clients` are those
    of the Modbus TCP face at any moment; `conditions` are None where nobody watches them.
    """

    def __init__(
        self,
        settings: HttpSettings,
        site: Site,
        clock: Clock,
        *,
        modbus: ModbusServerStats,
        snmp: Callable[[], Mapping[str, int]],
        not_ready: Callable[[], Sequence[str]],
        history: HistoryStats | None = None,
        log: DayLog | None = None,
        clients: Iterable[Client] = (),
        conditions: Conditions | None = None,
        notifications: Sequence[NotifyStats] = (),
        service: ServiceStats | None = None,
    ) -> None:
        self._site = site
        self._clock = clock
        self._not_ready = not_ready
        self.stats = HttpStats()
        self._settings = settings
        self._access = Access()
        self._counts = Counts(modbus, snmp, self.stats, not_ready, history, clients, conditions, notifications, service)
        self._exposition = Exposition(site, clock, self._counts)
        self._clients = clients
        self._conditions = conditions
        self._log_api = LogApi(site, log, settings.send_timeout_s)
        self.listeners: Sequence[HttpListener] = ()
        self.listeners = self._listeners()

    @property
    def access(self) -> Access:
        """The credentials that it goes by."""
        return self._access

    def adjust(
        self,
        settings: HttpSettings,
        access: Access,
        site: Site,
        *,
        history: HistoryStats | None,
        log: DayLog | None,
        conditions: Conditions | None,
        notifications: Sequence[NotifyStats],
    ) -> None:
        """Go on by other settings, with the credentials that were read of them, for another site.

        `listeners` are those that are wanted then: the same ones where address and kind are the same.
        """
        self._settings, self._access, self._site = settings, access, site
        self._conditions = conditions
        self._counts = replace(self._counts, history=history, conditions=conditions, notifications=notifications)
        self._exposition.adjust(site, self._counts)
        self._log_api.adjust(site, log)
        self.listeners = self._listeners()
        for listener in self.listeners:
            listener.adjust(settings)

    def _listeners(self) -> tuple[HttpListener, ...]:
        """The listeners of the settings; those that there are already are taken."""
        present = {listener.key: listener for listener in self.listeners}
        wanted = [
            HttpListener(host, port, self._application, self._settings, self.stats)
            for host, port in self._settings.listen
        ]
        return tuple(present.get(listener.key, listener) for listener in wanted)

    def _application(self) -> web.Application:
        self._access = Access.read(self._settings)
        guarded = guard(lambda: self._access, self._count_refused)
        application = web.Application(client_max_size=0, middlewares=[guarded])
        application.router.add_get("/", self._index)
        application.router.add_get("/metrics", self._metrics)
        application.router.add_get("/sd", self._discovery)
        application.router.add_get("/healthz", self._healthz)
        application.router.add_get("/readyz", self._readyz)
        application.router.add_get(api.PATH, self._log_api.handle)
        application.router.add_get(client_list.PATH, self._who_asks)
        application.router.add_get(condition_list.PATH, self._what_is_wrong)
        return application

    async def _metrics(self, request: web.Request) -> web.StreamResponse:
        began = self._clock.monotonic()
        form = negotiate(",".join(request.headers.getall("Accept", [])))
        headers = {**_NO_STORE, "Content-Type": form.content_type, "Vary": "Accept, Accept-Encoding"}
        pieces = self._exposition.pieces(form)
        if accepts_gzip(",".join(request.headers.getall("Accept-Encoding", []))):
            headers["Content-Encoding"] = "gzip"
            pieces = compressed(pieces)
        if request.method == hdrs.METH_HEAD:
            return web.Response(headers=headers)
        reply = web.StreamResponse(headers=headers)
        try:
            async with asyncio.timeout(self._settings.send_timeout_s):
                await reply.prepare(request)
                async for piece in pieces:
                    await reply.write(piece)
                await reply.write_eof()
        except TimeoutError:  # it asked, and does not read
            self.stats.abandoned += 1
            if request.transport is not None:
                request.transport.abort()
            return reply
        self.stats.scrapes += 1
        self.stats.scrape_s += self._clock.monotonic() - began
        return reply

    async def _discovery(self, request: web.Request) -> web.Response:
        assert request.transport is not None
        host, port, *_ = request.transport.get_extra_info("sockname")
        found = targets(self._site.name, request.host, (host, port), secure=request.secure)
        return web.json_response(found, headers=_NO_STORE)

    async def _who_asks(self, _request: web.Request) -> web.Response:
        found = client_list.clients_document(self._clients, self._clock.monotonic())
        return web.json_response(found, headers=_NO_STORE)

    async def _what_is_wrong(self, request: web.Request) -> web.Response:
        try:
            everything = condition_list.wants_all(request.query)
        except ValueError as error:
            return web.json_response({"error": str(error)}, status=400, headers=_NO_STORE)
        if self._conditions is None:
            return web.json_response({"error": "nobody watches conditions"}, status=404, headers=_NO_STORE)
        now = self._clock.monotonic()
        self._conditions.look(now)
        found = condition_list.conditions_document(self._conditions, now, everything=everything)
        return web.json_response(found, headers=_NO_STORE)

    def _count_refused(self) -> None:
        self.stats.refused += 1

    async def _healthz(self, _request: web.Request) -> web.Response:
        return web.Response(text="ok\n", headers=_NO_STORE)

    async def _readyz(self, _request: web.Request) -> web.Response:
        reasons = self._not_ready()
        if reasons:
            return web.Response(
                status=503, text="not ready\n" + "".join(f"{why}\n" for why in reasons), headers=_NO_STORE
            )
        return web.Response(text="ready\n", headers=_NO_STORE)

    async def _index(self, _request: web.Request) -> web.Response:
        page = index_page(self._site, self._clock.monotonic())
        return web.Response(text=page, content_type="text/html", headers=_PAGE_HEADERS)
