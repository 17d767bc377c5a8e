"""Ours beside prometheus-client's own rendering of the same registry, in both formats; and that nothing is held up."""

from __future__ import annotations

import asyncio
import random
import sys
import zlib
from collections import Counter
from dataclasses import replace
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st
from prometheus_client.exposition import generate_latest
from prometheus_client.openmetrics.exposition import generate_latest as generate_openmetrics

from gateway.core.conditions import Conditions
from gateway.core.site import Site
from gateway.core.snapshot import DeviceState, Snapshot
from gateway.core.stats import DeviceHistoryStats, HistoryStats, ModbusServerStats
from gateway.devices.model import Kind
from gateway.devices.schema import load_map, models
from gateway.faces.http.exposition import LOOKS_A_TURN, PIECE_BYTES, TURN_BYTES, Exposition, compressed
from gateway.faces.http.own import Counts, HttpStats
from gateway.faces.http.packing import packer
from gateway.faces.http.text import OPENMETRICS, TEXT, Format
from tests.faces.http.reference import registry
from tests.faces.http.scrapes import Seen, joined, parse, scrape, seen
from tests.optional import optional

from .conftest import VALUES, ManualClock, UnreadableLine, make_device, online

FORMATS = pytest.mark.parametrize("form", [TEXT, OPENMETRICS], ids=["text", "openmetrics"])


def rendered_by_the_client(site: Site, clock: ManualClock, counts: Counts, form: Format) -> bytes:
    kept = registry(site, clock, counts, clock.wall())
    if form.openmetrics:
        text: bytes = generate_openmetrics(kept)  # type: ignore[no-untyped-call]  # as upstream left it
        return text
    return generate_latest(kept)


def described(text: bytes, form: Format) -> set[tuple[str, str, str, str]]:
    """Name, type, unit and help of every family."""
    return {(family.name, family.type, family.unit, family.documentation) for family in parse(text, form)}


def without_process(samples: Seen) -> Seen:
    """Processor time and memory differ between two scrapes."""
    return {key: value for key, value in samples.items() if not key[0].startswith(("process_", "python_"))}


def busy_counts() -> Counts:
    modbus = ModbusServerStats(requests=7)
    modbus.exceptions[0x0B] = 4
    modbus.malformed['a "b"\\\n'] = 1
    history = HistoryStats(
        {3: DeviceHistoryStats(harvests=2, failures=Counter(timeout=1), days=256, harvested_at=900.0)}
    )
    http = HttpStats(scrapes=5, scrape_s=0.123456789)
    return Counts(modbus, lambda: {"bad_community": 6}, http, lambda: ["no"], history)


def busy_site(clock: ManualClock, model: str) -> Site:
    """Every point of a map with values of all sorts, names that need escaping, all states, histograms, conditions."""
    device_map = load_map(model)
    lines = [UnreadableLine('with "quotes", \\ and\nlines'), UnreadableLine("日本", index=2)]
    lines[0].stats.queue_wait.observe(0.003)
    lines[0].stats.queue_wait.observe(99)
    lines[0].stats.reply_time.observe(0.2)
    lines[0].stats.seconds_by_client["10.0.0.1"] = 1.5
    lines[0].stats.failed["offline"] = 3
    devices = [make_device(f"array-{unit}", unit, lines[unit % 2], device_map) for unit in range(1, 8)]
    values = (1, 0, 3, 1e9, -12.625, 4294967295)
    for device, value, state in zip(
        devices, values, (*DeviceState, DeviceState.ONLINE, DeviceState.ONLINE), strict=False
    ):
        device.snapshot = online(
            clock.now - value % 7,
            state=state,
            values={
                point.name: value if point.unit and point.metric_type == "gauge" else abs(int(value))
                for point in device_map.points
                if point.kind is not Kind.TEXT
            },
            texts={point.name: f'"{value}"\\' for point in device_map.points if point.kind is Kind.TEXT},
            warnings=frozenset({"identity_mismatch", "history_late"}) if value == 3 else frozenset(),
        )
    devices[1].stats.errors["crc"] = 2
    devices[1].stats.refresh_s = 1.0625
    return Site.of('Berg\\hütte "7"\n日本', lines, devices)


@FORMATS
@pytest.mark.parametrize("model", models())
def test_same_samples_as_prometheus_client(model: str, form: Format, clock: ManualClock) -> None:
    site, counts = busy_site(clock, model), busy_counts()
    exposition = Exposition(site, clock, counts)
    ours, theirs = scrape(exposition, form), rendered_by_the_client(site, clock, counts, form)
    assert without_process(seen(parse(ours, form))) == without_process(seen(parse(theirs, form)))
    assert len(seen(parse(ours, form))) > 1000
    assert described(ours, form) == described(theirs, form)


@FORMATS
def test_same_samples_of_models_side_by_side(form: Format, clock: ManualClock) -> None:
    """Every model between the others, devices that have some of their values, of all states, at several moments."""
    chance = random.Random(8)
    line = UnreadableLine("shelter-a")
    maps = [load_map(model) for model in models()]
    devices = [make_device(f"array-{unit}", unit, line, maps[unit % len(maps)]) for unit in range(1, 4 * len(maps))]
    site = Site.of("ridge-07", [line], devices)
    exposition = Exposition(site, clock, Counts())
    for _ in range(3):
        for device in devices:
            points = [point for point in device.map.points if chance.random() < 0.8]
            device.snapshot = online(
                clock.now,
                state=chance.choice((*DeviceState, *[DeviceState.ONLINE] * 4)),
                values={point.name: chance.randrange(20) for point in points if point.kind is not Kind.TEXT},
                texts={point.name: str(chance.random()) for point in points if point.kind is Kind.TEXT},
            )
        ours = seen(parse(scrape(exposition, form), form))
        theirs = seen(parse(rendered_by_the_client(site, clock, Counts(), form), form))
        assert without_process(ours) == without_process(theirs)


@FORMATS
def test_same_samples_after_every_kind_of_change(form: Format, site: Site, clock: ManualClock) -> None:
    counts = Counts()
    exposition = Exposition(site, clock, counts)
    first = online(clock.now)
    for snapshot in (
        Snapshot(),
        first,
        replace(first, values={**VALUES, "battery_voltage": 13.25, "charge_state": 0, "array_fault": 1 << 9}),
        replace(first, values={"energy": 3}),
        replace(first, state=DeviceState.STALE),
        replace(first, serial_number=None, warnings=frozenset({"identity_mismatch"})),
        replace(first, last_reply_at=clock.now + 5),
        replace(first, identification=None),
    ):
        site.devices[0].snapshot = snapshot
        clock.now += 7
        ours = seen(parse(scrape(exposition, form), form))
        theirs = seen(parse(rendered_by_the_client(site, clock, counts, form), form))
        assert without_process(ours) == without_process(theirs)


@given(
    names=st.tuples(*[st.text(st.characters(exclude_categories=["Cs", "Cc"]) | st.just("\n"), min_size=1)] * 3),
    value=st.floats(),
    form=st.sampled_from([TEXT, OPENMETRICS]),
)
def test_any_name_and_any_number_is_read_back(names: tuple[str, str, str], value: float, form: Format) -> None:  # F70
    clock = ManualClock()
    line = UnreadableLine(names[1])
    device = make_device(names[2], 1, line)
    device.snapshot = online(clock.now, values={"battery_voltage": value})
    text = scrape(Exposition(Site.of(names[0], [line], [device]), clock, Counts()), form)
    [found] = [family for family in parse(text, form) if family.name == "morningstar_battery_voltage_volts"]
    [sample] = found.samples
    assert [sample.labels[label] for label in ("site", "line", "device")] == list(names)
    assert sample.value == value or (sample.value != sample.value and value != value)  # noqa: PLR0124  NaN alone is not itself


def large_site(clock: ManualClock, count: int) -> Site:
    line = UnreadableLine("shelter-a")
    device_map = load_map(models()[0])
    devices = [make_device(f"array-{unit}", unit, line, device_map) for unit in range(1, count + 1)]
    for device in devices:
        device.snapshot = online(clock.now, values={point.name: 1 for point in device_map.points})
    return Site.of("ridge-07", [line], devices)


async def test_a_large_scrape_gives_way_to_others(clock: ManualClock) -> None:
    """A turn of the loop writes little: of a family with thousands of lines only a part."""
    count = 100
    site = large_site(clock, count)
    exposition = Exposition(site, clock, Counts(conditions=Conditions(site, (), clock.now)))
    turns = 0

    async def others() -> None:
        nonlocal turns
        while True:
            turns += 1
            await asyncio.sleep(0)

    other = asyncio.create_task(others())
    pieces = [len(piece) async for piece in exposition.pieces(TEXT)]
    other.cancel()
    part = 48 * 1024  # 227 lines
    assert all(PIECE_BYTES <= piece < PIECE_BYTES + part for piece in pieces[:-1])
    assert len(pieces) > 20
    assert turns >= count // LOOKS_A_TURN + sum(pieces) // (TURN_BYTES + part / 2)


async def test_conditions_are_those_of_the_snapshots_that_are_shown(clock: ManualClock) -> None:
    """They are looked at a few devices at a time."""
    site = large_site(clock, 3 * LOOKS_A_TURN)
    conditions = Conditions(site, (), clock.now)
    exposition = Exposition(site, clock, Counts(conditions=conditions))
    after_turns = [0]

    async def others() -> None:
        while True:
            after_turns.append(len(tuple(conditions.active())))
            await asyncio.sleep(0)

    other = asyncio.create_task(others())
    for value in (0, 1, 0):
        for device in site.devices:
            device.snapshot = online(clock.now, values={"array_faults": value})
        found = seen(parse(await joined(exposition.pieces(TEXT))))
        raised = Counter[str]()
        for (name, labels), number in found.items():
            if name == "prostar_gateway_conditions":
                raised[dict(labels)["unit_id"]] += int(number)
        assert raised == {str(device.unit_id): value for device in site.devices}
    other.cancel()
    assert max(after - before for before, after in pairwise(after_turns)) == LOOKS_A_TURN


async def test_a_poll_during_a_scrape_changes_nothing_of_it(clock: ManualClock) -> None:
    site = large_site(clock, 100)
    exposition = Exposition(site, clock, Counts())
    pieces = exposition.pieces(TEXT)
    begin = await anext(pieces)
    for device in site.devices:
        device.snapshot = online(clock.now, values=dict.fromkeys(device.snapshot.values, 0))
    found = seen(parse(begin + await joined(pieces)))
    changed = [value for (name, _), value in found.items() if name == "morningstar_hourmeter_seconds_total"]
    assert changed == [3600.0] * 100
    again = seen(parse(await joined(exposition.pieces(TEXT))))
    assert [value for (name, _), value in again.items() if name == "morningstar_hourmeter_seconds_total"] == [0.0] * 100


@pytest.mark.parametrize("library", ["ISA-L", "zlib"])
async def test_gzip_in_pieces_is_one_stream(clock: ManualClock, library: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if library == "ISA-L":
        optional("isal")
    else:
        monkeypatch.setitem(sys.modules, "isal.isal_zlib", None)
    assert isinstance(packer()[0], type(zlib.compressobj())) is (library == "zlib")
    exposition = Exposition(large_site(clock, 30), clock, Counts())
    stream = zlib.decompressobj(wbits=31)
    whole = b"".join([stream.decompress(piece) async for piece in compressed(exposition.pieces(TEXT))])
    assert (stream.eof, stream.unused_data) == (True, b"")
    assert len(whole) > 3 * PIECE_BYTES
    assert seen(parse(whole)).keys() == seen(parse(await joined(exposition.pieces(TEXT)))).keys()


def test_units_are_told_and_the_names_end_by_them(clock: ManualClock) -> None:
    text = scrape(Exposition(busy_site(clock, models()[0]), clock, Counts()), OPENMETRICS)
    units = dict(line.split()[2:4] for line in text.decode().splitlines() if line.startswith("# UNIT"))
    assert units["morningstar_battery_voltage_volts"] == "volts"
    assert units["morningstar_charge_energy_watthours"] == "watthours"
    assert units["morningstar_hourmeter_seconds"] == "seconds"
    assert units["morningstar_temperature_compensation_volts_per_celsius"] == "volts_per_celsius"
    assert units["prostar_gateway_line_discarded_bytes"] == "bytes"
    assert all(name.endswith(f"_{unit}") for name, unit in units.items())
    assert "morningstar_charge_state" not in units


def test_a_site_without_devices_is_scraped(clock: ManualClock) -> None:
    found = parse(scrape(Exposition(Site.of("ridge-07", [], []), clock, Counts())))
    assert "prostar_gateway_build_info" in {family.name for family in found}
    assert not [family for family in found if family.name.startswith("morningstar_")]
