"""Calls that block, each in a thread of its own, so that neither the loop nor another line ever waits for them.

The loop's shared pool would do for one line; with many lines whose terminal servers hang it would be full.
"""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections.abc import Callable
from typing import TypeVar

T = TypeVar("T")


def in_thread(call: Callable[[], T], *, late: Callable[[T], None], name: str) -> asyncio.Future[T]:
    """Start `call` now; the future has what it returns or raises.

    When nobody waits any more (the future was cancelled, the loop is closed), what it returned is given to
    `late`, in a thread too.
    """
    loop = asyncio.get_running_loop()
    future: asyncio.Future[T] = loop.create_future()

    def deliver(result: T) -> None:
        if future.done():
            threading.Thread(target=late, args=(result,), name=name, daemon=True).start()
        else:
            future.set_result(result)

    def refuse(error: Exception) -> None:
        if not future.done():
            future.set_exception(error)

    def work() -> None:
        try:
            result = call()
        except Exception as error:  # noqa: BLE001  # whatever it is, it belongs to who waits
            with contextlib.suppress(RuntimeError):  # the loop is closed
                loop.call_soon_threadsafe(refuse, error)
            return
        try:
            loop.call_soon_threadsafe(deliver, result)
        except RuntimeError:  # as above
            late(result)

    threading.Thread(target=work, name=name, daemon=True).start()
    return future
