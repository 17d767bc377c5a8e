"""The life of the process, from start to signal.

Rule 1: the first SIGTERM or SIGINT stops in order (service/supervisor.py), the second ends the process at once.
        Both leave exit status 0, also while it starts. When all is over signals are ignored until the interpreter has
        ended; a loop that handles them gives them back to the system when it is closed, which would end us by them.
        Threads that still wait then for a disk, or a file system that is gone, are waited for `LEAVE_S`, no longer.
Rule 2: when a part fails again and again, the gateway stops in the same order and leaves exit status 70, upon which
        systemd starts it anew.
Rule 3: SIGHUP has the configuration read again, and every file that it names (service/reload.py). One that comes while
        the gateway starts waits until then (cli/main.py blocks it).
"""

from __future__ import annotations

import asyncio
import logging
import os
import signal
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING

from gateway import __version__
from gateway.clock import SystemClock
from gateway.service.advice import advice
from gateway.service.garbage import set_aside
from gateway.service.gateway import Gateway
from gateway.service.logs import Log
from gateway.service.reload import Reloader
from gateway.service.settings import line_budgets
from gateway.service.systemd import Systemd

if TYPE_CHECKING:  # what it is at run time, plain.py says
    from gateway.service.schema import Config

EX_SOFTWARE = 70
"""sysexits.h: an internal mistake was found."""

LEAVE_S = 3.0

_log = logging.getLogger(__name__)


def serve(path: Path, config: Config, make_loop: Callable[[], asyncio.AbstractEventLoop], log: Log) -> int:
    """Run the gateway until a signal stops it; the exit status. `config` is what the file at `path` held."""
    with asyncio.Runner(loop_factory=make_loop) as runner:
        return runner.run(_serve(path, config, log))


async def _serve(path: Path, config: Config, log: Log) -> int:
    running = asyncio.get_running_loop()
    stop = asyncio.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        _on(number, running, _stopper(number, stop))
    systemd = Systemd(os.environ)
    clock = SystemClock()
    gateway = Gateway(config, clock, systemd)
    gateway.stats.log = log.stats
    reloader = Reloader(path, gateway, clock, systemd, log)
    gateway.keep(reloader)
    _on(signal.SIGHUP, running, reloader.wanted)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGHUP})
    for text in advice(config, line_budgets(config)):
        _log.warning('event=advice text="%s"', text.replace('"', "'"))
    _log.info(
        'event=started site="%s" version=%s lines=%d devices=%d loop=%s',
        config.site,
        __version__,
        len(gateway.lines),
        len(gateway.site.devices),
        type(running).__module__.partition(".")[0],
    )
    herald = asyncio.create_task(_announce(gateway, systemd))
    told = asyncio.create_task(_farewell(stop, systemd))
    try:
        await gateway.run(stop)
    finally:
        herald.cancel()
        told.cancel()
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    status = EX_SOFTWARE if gateway.supervisor.beyond_help else 0
    _log.info("event=stopped status=%d", status)
    _leave_soon(status)
    return status


def _leave_soon(status: int) -> None:
    """End the process although a thread does not end, after a while; a daemon's timer is none that is waited for."""

    def leave() -> None:
        logging.shutdown()
        os._exit(status)

    timer = threading.Timer(LEAVE_S, leave)
    timer.daemon = True
    timer.start()


async def _announce(gateway: Gateway, systemd: Systemd) -> None:
    """Say that the start is over: everything that listens does so, or was tried."""
    await gateway.supervisor.settled()
    set_aside()
    systemd.ready(gateway.summary())


async def _farewell(stop: asyncio.Event, systemd: Systemd) -> None:
    await stop.wait()
    systemd.stopping()


def _on(number: signal.Signals, loop: asyncio.AbstractEventLoop, act: Callable[[], None]) -> None:
    """Have the loop act upon a signal, in its turn; the handler stays when the loop is closed."""

    def handler(_number: int, _frame: FrameType | None) -> None:
        with suppress(RuntimeError):  # the loop is closed
            loop.call_soon_threadsafe(act)

    signal.signal(number, handler)


def _stopper(number: signal.Signals, stop: asyncio.Event) -> Callable[[], None]:
    def on_signal() -> None:
        if stop.is_set():
            logging.shutdown()
            os._exit(0)  # whoever signals twice does not want to wait for anything
        _log.info("event=stopping signal=%s", number.name)
        stop.set()

    return on_signal
