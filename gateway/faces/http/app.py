"""The HTTP face: everything from memory but `/api/v1/log`, which is from the history.

`/metrics`, `/sd`, `/api/v1/clients` and `/api/v1/conditions` for programs, a page for people, `/healthz` and `/readyz`
for supervisors.
Nothing here reads a line or waits for one, whatever is asked. `/healthz` answers as long as the loop runs;
`/readyz` says whether the configuration is served as it stands, and is not about the controllers: one that
is dead is seen in `/metrics`.
"""

from __future__ import annotations

import asyncio
import ssl
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace

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
from gateway.faces.http.request import JSON, NO_STORE, Handler, Reply, Request
from gateway.faces.http.settings import HttpSettings
from gateway.faces.http.text import accepts_gzip, negotiate

METHODS = ("GET", "HEAD")

_PAGE_FIELDS = (
    *NO_STORE,
    ("Content-Security-Policy", "default-src 'none'; style-src 'unsafe-inline'"),
    ("X-Content-Type-Options", "nosniff"),
)


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
        self._pages: Mapping[str, Handler] = {
            "/": self._index,
            "/metrics": self._metrics,
            "/sd": self._discovery,
            "/healthz": self._healthz,
            "/readyz": self._readyz,
            api.PATH: self._log_api.handle,
            client_list.PATH: self._who_asks,
            condition_list.PATH: self._what_is_wrong,
        }
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
        tls: ssl.SSLContext | None,
        history: HistoryStats | None,
        log: DayLog | None,
        conditions: Conditions | None,
        notifications: Sequence[NotifyStats],
    ) -> None:
        """Go on by other settings, with the credentials that were read of them, for another site.

        `tls` is what its certificate files were read into, None: they were not read, and those of before are in use.
        `listeners` are those that are wanted then: the same ones where address and kind are the same.
        """
        self._settings, self._access, self._site = settings, access, site
        self._conditions = conditions
        self._counts = replace(self._counts, history=history, conditions=conditions, notifications=notifications)
        self._exposition.adjust(site, self._counts)
        self._log_api.adjust(site, log)
        self.listeners = self._listeners()
        for listener in self.listeners:
            listener.adjust(settings, tls)

    def _listeners(self) -> tuple[HttpListener, ...]:
        """The listeners of the settings; those that there are already are taken."""
        present = {listener.key: listener for listener in self.listeners}
        wanted = [
            HttpListener(host, port, self._open, self._settings, clock=self._clock, stats=self.stats)
            for host, port in self._settings.listen
        ]
        return tuple(present.get(listener.key, listener) for listener in wanted)

    def _open(self) -> Handler:
        """What answers requests, with the credentials that the files hold now; ListenError when they hold none.

        While another port is open those in use hold: it is a reload that brings in others.
        """
        if not any(listener.bound for listener in self.listeners):
            self._access = Access.read(self._settings)
        return guard(self._answer, lambda: self._access, self._count_refused)

    async def _answer(self, request: Request) -> Reply | None:
        handler = self._pages.get(request.path)
        if handler is None:
            return Reply(404, b"there is no such page\n")
        if request.head.method not in METHODS:
            return Reply(405, b"pages are read\n", fields=(*NO_STORE, ("Allow", ", ".join(METHODS))))
        if request.head.body:
            return Reply(413, b"a request has no body\n")
        return await handler(request)

    async def _metrics(self, request: Request) -> Reply | None:
        began = self._clock.monotonic()
        form = negotiate(request.field("accept"))
        fields = [*NO_STORE, ("Content-Type", form.content_type), ("Vary", "Accept, Accept-Encoding")]
        pieces = self._exposition.pieces(form)
        if accepts_gzip(request.field("accept-encoding")):
            fields.append(("Content-Encoding", "gzip"))
            pieces = compressed(pieces)
        request.by.begin(fields)
        if request.head_only:
            return None
        try:
            async with asyncio.timeout(self._settings.send_timeout_s):
                async for piece in pieces:
                    await request.by.write(piece)
                await request.by.end()
        except TimeoutError:  # it asked, and does not read
            self.stats.abandoned += 1
            request.by.abort()
            return None
        self.stats.scrapes += 1
        self.stats.scrape_s += self._clock.monotonic() - began
        return None

    async def _discovery(self, request: Request) -> Reply:
        by = request.by
        return Reply.json(targets(self._site.name, request.head.host, by.local, secure=by.secure))

    async def _who_asks(self, _request: Request) -> Reply:
        return Reply.json(client_list.clients_document(self._clients, self._clock.monotonic()))

    async def _what_is_wrong(self, request: Request) -> Reply | None:
        try:
            everything = condition_list.wants_all(request.query)
        except ValueError as error:
            return Reply.json({"error": str(error)}, 400)
        if self._conditions is None:
            return Reply.json({"error": "nobody watches conditions"}, 404)
        now = self._clock.monotonic()
        self._conditions.look(now)
        request.by.begin((*NO_STORE, ("Content-Type", JSON)))
        if request.head_only:
            return None
        try:
            async with asyncio.timeout(self._settings.send_timeout_s):
                for piece in condition_list.conditions_pieces(self._conditions, now, everything=everything):
                    await request.by.write(piece)
                    await asyncio.sleep(0)
                await request.by.end()
        except TimeoutError:
            request.by.abort()
        return None

    def _count_refused(self) -> None:
        self.stats.refused += 1

    async def _healthz(self, _request: Request) -> Reply:
        return Reply(200, b"ok\n")

    async def _readyz(self, _request: Request) -> Reply:
        reasons = self._not_ready()
        if reasons:
            return Reply(503, "".join(f"{line}\n" for line in ("not ready", *reasons)).encode())
        return Reply(200, b"ready\n")

    async def _index(self, _request: Request) -> Reply:
        page = index_page(self._site, self._clock.monotonic())
        return Reply(200, page.encode(), "text/html; charset=utf-8", _PAGE_FIELDS)
