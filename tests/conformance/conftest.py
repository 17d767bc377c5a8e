"""What is said of the TCP side is checked on the site in memory of the Modbus TCP face, on both event loops."""

from __future__ import annotations

from tests.faces.modbus.conftest import (
    pytest_asyncio_loop_factories,
    running,
    serve,
    world,
)

__all__ = ["pytest_asyncio_loop_factories", "running", "serve", "world"]
