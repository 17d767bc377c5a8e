"""What every exporter tells of its process, under the names and with the meaning of prometheus-client's collectors.

`process_*` come from /proc and are absent where there is none; `python_gc_*` are the garbage collector's counters.
prometheus-client itself would do; to a running gateway it would bring its HTTP server, its HTTP client and `email`:
3 MiB. tests/faces/http/test_process.py compares the two.
"""

from __future__ import annotations

import gc
import os
import resource
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from math import inf
from pathlib import Path

from gateway.faces.http.metric import MetricInfo, counter, gauge
from gateway.faces.http.rules import Rule, Source, each, families, known
from gateway.faces.http.text import Lines

PROC = Path("/proc")


@dataclass(frozen=True, slots=True)
class ProcessView:
    """The process at this moment; None where the system does not tell."""

    virtual: float | None = None  # bytes
    resident: float | None = None  # bytes
    started_at: float | None = None  # wall clock
    cpu_s: float | None = None
    open_fds: float | None = None
    max_fds: float | None = None

    @classmethod
    def now(cls, proc: Path = PROC) -> ProcessView:
        """What /proc tells (proc(5)): of `stat` the fields behind the name, which may hold anything."""
        with suppress(OSError, ValueError, IndexError):
            fields = (proc / "self/stat").read_bytes().rpartition(b")")[2].split()
            ticks = os.sysconf("SC_CLK_TCK")
            most, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
            return cls(
                virtual=float(fields[20]),
                resident=float(fields[21]) * resource.getpagesize(),
                started_at=_booted_at(proc) + float(fields[19]) / ticks,
                cpu_s=float(fields[11]) / ticks + float(fields[12]) / ticks,
                open_fds=float(sum(1 for _ in (proc / "self/fd").iterdir())),
                max_fds=inf if most == resource.RLIM_INFINITY else float(most),
            )
        return cls()


def _booted_at(proc: Path) -> float:
    with (proc / "stat").open("rb") as rows:
        return next(float(row.split()[1]) for row in rows if row.startswith(b"btime "))


PROCESS_RULES: tuple[Rule[ProcessView], ...] = (
    known(gauge("process_virtual_memory_bytes", "Virtual memory size in bytes."), lambda view: view.virtual),
    known(gauge("process_resident_memory_bytes", "Resident memory size in bytes."), lambda view: view.resident),
    known(
        gauge("process_start_time_seconds", "Start time of the process since unix epoch in seconds."),
        lambda view: view.started_at,
    ),
    known(
        counter("process_cpu_seconds_total", "Total user and system CPU time spent in seconds."),
        lambda view: view.cpu_s,
    ),
    known(gauge("process_open_fds", "Number of open file descriptors."), lambda view: view.open_fds),
    known(gauge("process_max_fds", "Maximum number of open file descriptors."), lambda view: view.max_fds),
)

Generations = Sequence[Mapping[str, int]]
"""What `gc.get_stats` gives."""


def _by_generation(name: str, text: str, key: str) -> Rule[Generations]:
    return each(
        counter(name, text, "generation"),
        lambda generations: {str(number): of[key] for number, of in enumerate(generations)},
    )


GARBAGE_RULES: tuple[Rule[Generations], ...] = (
    _by_generation("python_gc_objects_collected_total", "Objects collected during gc", "collected"),
    _by_generation("python_gc_objects_uncollectable_total", "Uncollectable objects found during GC", "uncollectable"),
    _by_generation("python_gc_collections_total", "Number of times this generation was collected", "collections"),
)


def process_families() -> Iterator[tuple[MetricInfo, Lines]]:
    """Each family that has samples, with its lines."""
    yield from families(PROCESS_RULES, [Source(ProcessView.now())])
    generations: Generations = gc.get_stats()
    yield from families(GARBAGE_RULES, [Source(generations)])
