from __future__ import annotations

import subprocess
from collections.abc import Callable

import pytest

from gateway.devices.codecs import CODECS
from gateway.devices.model import DeviceMap
from gateway.devices.schema import load_map, models
from gateway.devices.texts import TEXT_CODECS
from gateway.faces.http.devices import DEVICE_METRICS
from gateway.faces.http.own import OWN_METRICS
from gateway.generate.markdown import page, table
from gateway.generate.metrics import metric_outputs
from gateway.generate.registers import register_page


@pytest.fixture(scope="module", params=models())
def device_map(request: pytest.FixtureRequest) -> DeviceMap:
    return load_map(request.param)


def _cells(text: str, name: str) -> list[str]:
    """The cells of the first table row that names `name` in code type."""
    row = next(line for line in text.splitlines() if line.startswith("|") and f"`{name}`" in line)
    return [cell.strip() for cell in row.replace("| |", "|  |").strip("|").split(" | ")]


def test_a_table_survives_bars_and_line_ends() -> None:
    assert table(("A", "B"), [("x|y", "two\nlines")]) == "| A | B |\n| --- | --- |\n| x\\|y | two lines |"


def test_every_row_has_as_many_cells_as_its_heading() -> None:
    for text in [*(register_page(load_map(model)) for model in models()), *metric_outputs().values()]:
        width = 0
        for line in text.splitlines():
            if not line.startswith("|"):
                width = 0
                continue
            bars = line.replace("\\|", "").count("|")
            width = width or bars
            assert bars == width, line


def test_a_page_ends_with_one_line_end() -> None:
    assert page(["# A", "b\n\n"]) == "# A\n\nb\n"


def test_every_point_has_its_row(device_map: DeviceMap) -> None:
    text = register_page(device_map)
    for point in device_map.points:
        row = next(
            line
            for line in text.splitlines()
            if line.startswith(f"| `0x{point.address:04X}") and f"`{point.name}`" in line
        )
        assert f"`{point.symbol}`" in row
        codec = point.reading().codec
        assert (TEXT_CODECS[codec].text if codec in TEXT_CODECS else CODECS[codec].text) in row
        assert point.help in row
        assert (point.metric or "") in row


def test_every_reserved_range_has_its_row(device_map: DeviceMap) -> None:
    lines = register_page(device_map).splitlines()
    for run in device_map.reserved:
        address = f"0x{run.first:04X}" if run.first == run.last else f"0x{run.first:04X}–0x{run.last:04X}"
        assert any(line.startswith(f"| `{address}` | *reserved* |") for line in lines)


def test_every_other_reading_and_note_is_on_the_page(device_map: DeviceMap) -> None:
    text = register_page(device_map)
    for point in device_map.points:
        assert point.note in text
        for reading in point.readings[1:]:
            assert f"| `{reading.name}` |" in text
            assert reading.evidence[1:] in text


def test_every_value_and_bit_is_on_the_page(device_map: DeviceMap) -> None:
    text = register_page(device_map)
    for values in device_map.enumerations.values():
        for value in values:
            assert f"| {value.number} | `{value.name}` | {value.text} |" in text
    for bits in device_map.bit_tables.values():
        for bit in bits:
            assert f"| {bit.number} | `{bit.name}` | {bit.severity} | {bit.text} |" in text


def test_every_metric_is_listed_once() -> None:
    text = metric_outputs()["docs/metrics.md"]
    of_points = {point.metric for model in models() for point in load_map(model).points if point.metric is not None}
    names = sorted({*of_points, *(info.name for info in (*DEVICE_METRICS, *OWN_METRICS))})
    listed = [line for line in text.split("### Values of the labels")[0].splitlines() if line.startswith("| `m")]
    assert len(listed) == len(of_points) + len(DEVICE_METRICS)
    for name in names:
        assert f"| `{name}` |" in text


def test_a_metric_row_says_type_unit_and_label() -> None:
    text = metric_outputs()["docs/metrics.md"]
    assert _cells(text, "morningstar_charge_energy_watthours_total")[1:4] == ["counter", "watthours", ""]
    assert _cells(text, "morningstar_charge_energy_resettable_watthours")[1:4] == ["gauge", "watthours", ""]
    assert _cells(text, "morningstar_charge_state")[1:4] == ["gauge", "", "`state`"]
    assert _cells(text, "morningstar_alarms")[1:4] == ["gauge", "", "`bit`"]


@pytest.mark.peer
def test_promtool_likes_the_names(peer: Callable[[str], str]) -> None:
    metrics = {point.metric: point for model in models() for point in load_map(model).points if point.metric}
    text = "".join(
        f"# HELP {name} {point.help}\n# TYPE {name} {point.metric_type}\n{name} 1\n" for name, point in metrics.items()
    )
    done = subprocess.run(
        [peer("promtool"), "check", "metrics"], input=text, capture_output=True, text=True, timeout=60, check=False
    )
    assert (done.returncode, done.stdout + done.stderr) == (0, "")
