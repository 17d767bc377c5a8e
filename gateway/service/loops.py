"""Which event loop the gateway runs on: uvloop where it is installed, else asyncio's own."""

from __future__ import annotations

import asyncio
import importlib
from collections.abc import Callable
from enum import StrEnum


class Loop(StrEnum):
    """The choice of the command line."""

    AUTO = "auto"
    ASYNCIO = "asyncio"
    UVLOOP = "uvloop"


def loop_factory(choice: Loop) -> Callable[[], asyncio.AbstractEventLoop]:
    """What makes the loop; ValueError when uvloop was asked for by name and is not installed."""
    if choice is Loop.ASYNCIO:
        return asyncio.new_event_loop
    try:
        factory: Callable[[], asyncio.AbstractEventLoop] = importlib.import_module("uvloop").new_event_loop
    except ImportError:
        if choice is Loop.UVLOOP:
            raise ValueError("uvloop is not installed") from None
        return asyncio.new_event_loop
    return factory
