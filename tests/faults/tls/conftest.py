"""The rows of Modbus/TCP Security use the site and the certificates of its own tests, on both event loops."""

from __future__ import annotations

from tests.faces.modbus.conftest import pytest_asyncio_loop_factories, serve, world
from tests.faces.modbus.tls.conftest import pki, serve_tls

__all__ = ["pki", "pytest_asyncio_loop_factories", "serve", "serve_tls", "world"]
