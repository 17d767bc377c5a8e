"""The process's own metrics: those of prometheus-client's collectors, and nothing where there is no /proc."""

from __future__ import annotations

import gc
from pathlib import Path

import pytest
from prometheus_client import CollectorRegistry, GCCollector, ProcessCollector
from prometheus_client.metrics_core import Metric
from prometheus_client.parser import text_string_to_metric_families

from gateway.faces.http.process import ProcessView, process_families
from gateway.faces.http.text import TEXT, header


def ours() -> dict[str, Metric]:
    text = b"".join(header(info, TEXT) + b"".join(lines) for info, lines in process_families()).decode()
    return {family.name: family for family in text_string_to_metric_families(text)}


def theirs() -> dict[str, Metric]:
    registry = CollectorRegistry()
    ProcessCollector(registry=registry)
    GCCollector(registry=registry)
    return {family.name: family for family in registry.collect()}


def test_names_kinds_and_help_are_those_of_prometheus_client() -> None:
    mine, client = ours(), theirs()
    assert [(each.name, each.type, each.documentation) for each in mine.values()] == [
        (each.name, each.type, each.documentation) for each in client.values()
    ]


def test_the_values_are_those_of_prometheus_client() -> None:
    before, mine, after = theirs(), ours(), theirs()
    for name in ("process_start_time_seconds", "process_max_fds"):
        assert [sample.value for sample in mine[name].samples] == [sample.value for sample in before[name].samples]
    for name in ("process_cpu_seconds", "python_gc_collections", "python_gc_objects_collected"):
        values = [[sample.value for sample in found[name].samples] for found in (before, mine, after)]
        assert all(first <= second <= third for first, second, third in zip(*values, strict=True))
    [resident] = mine["process_resident_memory_bytes"].samples
    assert resident.value == pytest.approx(before["process_resident_memory_bytes"].samples[0].value, rel=0.2)
    labels = [sample.labels for sample in mine["python_gc_collections"].samples]
    assert labels == [{"generation": str(number)} for number, _ in enumerate(gc.get_stats())]


def test_open_descriptors_are_counted(tmp_path: Path) -> None:
    before = ProcessView.now().open_fds
    assert before is not None
    with (tmp_path / "one").open("w"), (tmp_path / "two").open("w"):
        assert ProcessView.now().open_fds == before + 2


@pytest.mark.parametrize("stat", [None, b"", b"1 (a) b) S 1", b"1 (a) S " + b"x " * 40])
def test_where_proc_does_not_tell_there_is_nothing(tmp_path: Path, stat: bytes | None) -> None:
    (tmp_path / "self").mkdir()
    if stat is not None:
        (tmp_path / "self/stat").write_bytes(stat)
    assert ProcessView.now(tmp_path) == ProcessView()
