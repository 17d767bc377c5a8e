"""A server with TLS in front of the site in memory, and certificates for it."""

from __future__ import annotations

import time
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from gateway.core.stats import TlsStats
from gateway.errors import TlsFilesError
from gateway.faces.modbus.settings import TlsSettings
from gateway.faces.modbus.tls import TlsDoor
from gateway.faces.modbus.tls_files import load
from tests.faces.modbus.conftest import Client, Running, Serve, World
from tests.faces.modbus.tls.site import Pki


@pytest.fixture
def pki(tmp_path: Path, peer: Callable[[str], str]) -> Pki:
    peer("openssl")
    return Pki.of_the_recipe(tmp_path / "pki")


@pytest.fixture
def pki_rsa(pki: Pki) -> None:
    """Have the site's certificates made with RSA keys, as the document says it."""
    Pki.of_the_recipe(pki.folder, rsa=True)


@dataclass(eq=False)
class TlsSite:
    """A running server with one TLS listener."""

    running: Running
    pki: Pki

    @property
    def world(self) -> World:
        return self.running.world

    @property
    def stats(self) -> TlsStats:
        stats = self.running.world.stats.tls
        assert stats is not None
        return stats

    @property
    def door(self) -> TlsDoor:
        door = self.running.server.door
        assert door is not None
        return door

    def reload(self) -> None:
        """Have the files read again, as the service does on SIGHUP."""
        settings, server = self.running.server.settings.tls, self.running.server
        assert settings is not None
        try:
            credentials = load(settings.files, self.world.clock.wall())
        except TlsFilesError as error:
            server.files_unusable(str(error))
        else:
            self.door.adjust(settings, credentials)

    async def connect(self, name: str | None, **options: Any) -> Client:
        """A client with that certificate."""
        context = options.pop("context", None) or self.pki.client(name, options.pop("version", None))
        return await self.running.connect(ssl=context, server_hostname="localhost", **options)


ServeTls = Callable[..., Awaitable[TlsSite]]


@pytest.fixture
def serve_tls(serve: Serve, world: World, pki: Pki, monkeypatch: pytest.MonkeyPatch) -> ServeTls:
    """Start a TLS server; `require_role`, `crl` and `handshake_timeout_s` are of TLS, the rest are of the face."""
    monkeypatch.setattr(world.clock, "wall", time.time)  # certificates are of this year

    async def start(*, crl: bool = False, tls: dict[str, Any] | None = None, **settings: Any) -> TlsSite:
        options = TlsSettings((("127.0.0.1", 0),), pki.files(crl=crl), **(tls or {}))
        return TlsSite(await serve(listen=(), tls=options, **settings), pki)

    return start
