from __future__ import annotations

import asyncio
import csv
import io
import json
import threading
import time
from collections.abc import Iterator
from contextlib import aclosing, closing
from dataclasses import replace
from pathlib import Path

import pytest
from prometheus_client.metrics_core import Metric
from prometheus_client.openmetrics.parser import text_string_to_metric_families

from gateway.core.daylog import LogFormat, Selection
from gateway.devices.schema import load_map
from gateway.errors import HistoryError
from gateway.faces.http.devices import DEVICE_LABELS
from gateway.history.dates import HOUR_S
from gateway.history.export import PIECE, export, rows_to_read
from gateway.history.identity import Place
from gateway.history.openmetrics import LABELS, daily_metrics
from gateway.history.reader import HistoryReader, StoredDay
from gateway.history.source import HistorySource
from gateway.history.store import Store
from tests.history.blocks import LAYOUT, WALL, block, seen

ALL = Selection()
NEWEST = 1000 + 24 * 99
DAY_S = 86_400.0


def text(directory: Path, form: LogFormat, selection: Selection = ALL) -> str:
    with HistoryReader(directory) as reader:
        return "".join(export(reader, form, selection, "ridge-07"))


def parsed(directory: Path) -> dict[str, Metric]:
    written = text(directory, LogFormat.OPENMETRICS)
    assert written.endswith("# EOF\n")
    families = text_string_to_metric_families(written)  # type: ignore[no-untyped-call]  # as upstream left it
    return {family.name: family for family in families}


def test_json_has_every_day_and_what_is_apart(history: Path) -> None:
    found = json.loads(text(history, LogFormat.JSON))
    assert len(found["days"]) == 102
    (newest,) = (day for day in found["days"] if day["hourmeter_hours"] == NEWEST)
    assert newest == {
        "site": "ridge-07",
        "line": "shelter-a",
        "device": "array-1",
        "unit_id": 11,
        "model": "prostar-mppt",
        "controller": "shelter-a/array-1",
        "hourmeter_hours": NEWEST,
        "written_at": "2026-11-18T06:06:40Z",
        "error_seconds": 3678,
        "harvested_at": "2026-11-18T11:06:40Z",
        "alarms": [],
        "load_faults": [],
        "array_faults": [],
        "battery_voltage_minimum_volts": 12.5 - 19 / 128,
        "battery_voltage_maximum_volts": 14.25,
        "charge_amperehours": 60.0,
        "load_charge_amperehours": 55.0,
        "array_voltage_maximum_volts": 70.0,
        "absorption_time_seconds": 9000,
        "equalize_time_seconds": 0,
        "float_time_seconds": 5400,
        "words": block(NEWEST, low_v=12.5 - 19 / 128).hex(),
    }
    (apart,) = found["apart"]
    assert (apart["device"], apart["slot"], apart["hourmeter_hours"], apart["why"]) == ("array-1", 100, NEWEST, "tie")


def test_alarms_have_their_names_and_values_that_are_none_are_null(history: Path) -> None:
    days = {day["hourmeter_hours"]: day for day in json.loads(text(history, LogFormat.JSON))["days"]}
    names = {bit.number: bit.name for bit in load_map("prostar-mppt").bit_tables["alarms"]}
    assert days[NEWEST - 48]["alarms"] == [names[0], names[2]]
    assert days[NEWEST - 24]["alarms"] == [names[0], names.get(31, "bit_31")]
    assert days[NEWEST - 24]["battery_voltage_minimum_volts"] is None
    assert (days[74]["written_at"], days[74]["error_seconds"]) == (None, None)


def test_json_lines_and_csv_say_the_same(history: Path) -> None:
    days = json.loads(text(history, LogFormat.JSON))["days"]
    assert [json.loads(line) for line in text(history, LogFormat.JSONL).splitlines()] == days
    rows = list(csv.DictReader(io.StringIO(text(history, LogFormat.CSV))))
    assert len(rows) == len(days)
    for row, day in zip(rows, days, strict=True):
        flat = {name: " ".join(cell) if isinstance(cell, list) else cell for name, cell in day.items()}
        assert row == {name: "" if cell is None else str(cell) for name, cell in flat.items()}


@pytest.mark.parametrize(
    ("selection", "hours"),
    [
        (Selection("array-1", since=WALL - 2 * DAY_S), [NEWEST - 24, NEWEST]),
        (Selection(since=WALL - 5 * HOUR_S), [NEWEST]),
        (Selection(until=WALL - 5 * HOUR_S - 98 * DAY_S), [1000]),
        (Selection("array-1", WALL - 3 * DAY_S, WALL - 2 * DAY_S), [NEWEST - 48]),
        (Selection('the "second"'), [50, 74]),
        (Selection('the "second"', since=0.0), []),
        (Selection("nobody"), []),
    ],
)
def test_a_selection_is_by_device_and_date(history: Path, selection: Selection, hours: list[int]) -> None:
    lines = text(history, LogFormat.JSONL, selection).splitlines()
    assert [json.loads(line)["hourmeter_hours"] for line in lines] == hours
    with HistoryReader(history) as reader:
        assert reader.count(selection) == len(hours)


def test_openmetrics_is_what_the_format_wants(history: Path) -> None:
    families = parsed(history)
    assert families.keys() == {metric.name for metric in daily_metrics()}
    charge = families["morningstar_charge_daily_amperehours"]
    assert (charge.type, charge.unit, len(charge.samples)) == ("gauge", "amperehours", 100)
    newest = charge.samples[-1]
    assert newest.labels == {
        "device": "array-1",
        "line": "shelter-a",
        "model": "prostar-mppt",
        "site": "ridge-07",
        "unit_id": "11",
        "controller": "shelter-a/array-1",
    }
    assert (newest.value, float(str(newest.timestamp))) == (60.0, WALL - 5 * HOUR_S)
    (hourmeter,) = (s.value for s in families["morningstar_hourmeter_daily_seconds"].samples[-1:])
    assert hourmeter == NEWEST * 3600
    assert len(families["morningstar_battery_voltage_minimum_daily_volts"].samples) == 99


def test_bits_that_occurred_have_a_series_over_all_days(history: Path) -> None:
    families = parsed(history)
    samples = families["morningstar_alarms_daily"].samples
    by_bit: dict[str, list[float]] = {}
    for sample in samples:
        by_bit.setdefault(sample.labels["bit"], []).append(sample.value)
    names = {bit.number: bit.name for bit in load_map("prostar-mppt").bit_tables["alarms"]}
    assert {bit: (len(values), sum(values)) for bit, values in by_bit.items()} == {
        names[0]: (100, 2),
        names[2]: (100, 1),
        "bit_31": (100, 1),
    }
    assert families["morningstar_load_faults_daily"].samples == []


def test_labels_are_those_of_the_metrics() -> None:
    assert (*DEVICE_LABELS, "controller") == LABELS


def test_the_page_names_every_metric() -> None:
    page = (Path(__file__).parents[2] / "docs" / "history.md").read_text()
    for metric in daily_metrics():
        assert f"`{metric.name}`" in page


@pytest.mark.parametrize("form", list(LogFormat))
def test_an_export_comes_in_pieces_and_tells_its_progress(history: Path, form: LogFormat) -> None:
    done: list[int] = []
    with HistoryReader(history) as reader:
        pieces = list(export(reader, form, ALL, "ridge-07", done.append))
        assert sum(done) == rows_to_read(reader, form, ALL)
    assert all(len(piece) >= PIECE for piece in pieces[:-1])
    assert len(pieces) > 1 or form is LogFormat.CSV


def test_times_of_a_controller_rise_whatever_was_estimated(history: Path) -> None:
    import sqlite3

    from gateway.history.database import FILE_NAME

    connection = sqlite3.connect(history / FILE_NAME)
    connection.execute("UPDATE day SET written_wall = ? WHERE hourmeter > ?", (WALL, NEWEST - 100))
    connection.commit()
    connection.close()
    with HistoryReader(history) as reader:
        times = [day.written_at for day in reader.days(Selection("array-1")) if day.written_at is not None]
    assert len(times) == len(set(times)) == 100
    assert times == sorted(times)


@pytest.mark.parametrize("form", list(LogFormat))
def test_an_export_shows_the_history_of_one_moment(history: Path, form: LogFormat) -> None:
    whole = text(history, form)
    with HistoryReader(history) as reader, closing(Store(history, session=2)) as store:
        counted = rows_to_read(reader, form, ALL)
        store.shift((1, 2), 5000.0)
        place = Place("shelter-c", "array-3", 13)
        other = replace(seen(50, place=place), model="tristar-mppt")  # the first of its model
        store.keep_ring(other, LAYOUT, {0: block(50)})
        done: list[int] = []
        assert "".join(export(reader, form, ALL, "ridge-07", done.append)) == whole
        assert sum(done) == counted


def test_without_a_file_it_says_so(tmp_path: Path) -> None:
    with pytest.raises(HistoryError, match="there is no history yet"):
        HistoryReader(tmp_path)


async def test_the_source_reads_beside_the_loop(history: Path) -> None:
    source = HistorySource(history, "ridge-07")
    assert await source.devices() == {"array-1", 'the "second"'}
    got = b"".join([piece async for piece in source.export(LogFormat.JSON, ALL)])
    assert got.decode() == text(history, LogFormat.JSON)


@pytest.mark.parametrize("after", [0, 1])
async def test_an_export_that_is_broken_off_closes_its_file(
    history: Path, after: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    entered, closed_while_reading = threading.Event(), []
    real_days, real_close = HistoryReader.days, HistoryReader.close
    reading = threading.Lock()

    def slow_days(reader: HistoryReader, selection: Selection) -> Iterator[StoredDay]:
        for number, day in enumerate(real_days(reader, selection)):
            with reading:
                if number == 100 * after:
                    entered.set()
                    time.sleep(0.05)
            yield day

    def close(reader: HistoryReader) -> None:
        closed_while_reading.append(reading.locked())
        real_close(reader)

    monkeypatch.setattr(HistoryReader, "days", slow_days)
    monkeypatch.setattr(HistoryReader, "close", close)

    async def take() -> None:
        async with aclosing(HistorySource(history, "ridge-07").export(LogFormat.JSON, ALL)) as pieces:
            async for _ in pieces:
                pass

    task = asyncio.create_task(take())
    await asyncio.to_thread(entered.wait)
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    assert closed_while_reading == [False]
