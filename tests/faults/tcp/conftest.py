"""The rows of the Modbus TCP face use the site in memory of its own tests, on both event loops."""

from __future__ import annotations

from tests.faces.modbus.conftest import (
    pytest_asyncio_loop_factories,
    running,
    serve,
    world,
)

__all__ = ["pytest_asyncio_loop_factories", "running", "serve", "world"]
