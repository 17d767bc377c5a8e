"""The HTTP face: `/metrics`, `/healthz`, `/readyz` and an index page, all from memory.

Nothing here reads a line or waits for one, whatever is asked. `/healthz` answers as long as the loop runs;
`/readyz` says whether the configuration is served as it stands, and is not about the controllers: one that
is dead is seen in `/metrics`.
"""

from __future__ import annotations

import gzip
from collections.abc import Callable, Mapping, Sequence

from aiohttp import web
from prometheus_client import CollectorRegistry, GCCollector, ProcessCollector
from prometheus_client.exposition import CONTENT_TYPE_PLAIN_0_0_4, choose_encoder, generate_latest

from gateway.clock import Clock
from gateway.core.site import Site
from gateway.core.stats import ModbusServerStats
from gateway.faces.http.devices import DeviceCollector
from gateway.faces.http.listener import HttpListener
from gateway.faces.http.own import Counts, HttpStats, OwnCollector
from gateway.faces.http.page import index_page
from gateway.faces.http.settings import HttpSettings

_GZIP_LEVEL = 1  # a tenth of the size already; higher levels cost the loop more time than they save
_NO_STORE = {"Cache-Control": "no-store"}
_PAGE_HEADERS = {
    **_NO_STORE,
    "Content-Security-Policy": "default-src 'none'; style-src 'unsafe-inline'",
    "X-Content-Type-Options": "nosniff",
}


class HttpFace:
    """Metrics and health of one gateway.

    `modbus` and `snmp` are the counters of the other faces; `not_ready` gives the reasons why the gateway
    is not ready, none when it is.
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
    ) -> None:
        self._site = site
        self._clock = clock
        self._not_ready = not_ready
        self.stats = HttpStats()
        self._registry = CollectorRegistry()
        self._registry.register(DeviceCollector(site, clock))
        self._registry.register(OwnCollector(site, clock, Counts(modbus, snmp, self.stats)))
        ProcessCollector(registry=self._registry)
        GCCollector(registry=self._registry)
        self.listeners: Sequence[HttpListener] = tuple(
            HttpListener(host, port, self._application, settings, self.stats) for host, port in settings.listen
        )

    def _application(self) -> web.Application:
        application = web.Application(client_max_size=0)
        application.router.add_get("/", self._index)
        application.router.add_get("/metrics", self._metrics)
        application.router.add_get("/healthz", self._healthz)
        application.router.add_get("/readyz", self._readyz)
        return application

    async def _metrics(self, request: web.Request) -> web.Response:
        began = self._clock.monotonic()
        encode, content_type = _encoder(",".join(request.headers.getall("Accept", [])))
        body = encode(self._registry)
        headers = {**_NO_STORE, "Content-Type": content_type, "Vary": "Accept, Accept-Encoding"}
        if accepts_gzip(",".join(request.headers.getall("Accept-Encoding", []))):
            body = gzip.compress(body, _GZIP_LEVEL)
            headers["Content-Encoding"] = "gzip"
        self.stats.scrapes += 1
        self.stats.scrape_s += self._clock.monotonic() - began
        return web.Response(body=body, headers=headers)

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


def _encoder(accept: str) -> tuple[Callable[[CollectorRegistry], bytes], str]:
    try:
        return choose_encoder(accept)
    except (TypeError, ValueError):  # a version that is no number: the format that everybody reads
        return generate_latest, CONTENT_TYPE_PLAIN_0_0_4


def accepts_gzip(accept_encoding: str) -> bool:
    """Whether an Accept-Encoding header allows gzip (RFC 9110 §12.5.3)."""
    star = False
    for item in accept_encoding.split(","):
        coding, _, parameters = item.partition(";")
        name, _, weight = parameters.strip().partition("=")
        refused = name.strip().lower() == "q" and not weight.strip(" 0.")
        coding = coding.strip().lower()
        if coding in {"gzip", "x-gzip"}:
            return not refused
        star = star or (coding == "*" and not refused)
    return star
