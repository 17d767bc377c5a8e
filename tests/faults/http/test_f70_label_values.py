"""F70: names in the configuration with quotes, backslashes and UTF-8 are escaped, so that parsers read them back."""

from __future__ import annotations

import asyncio
import json
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest
from prometheus_client.metrics_core import Metric
from prometheus_client.openmetrics import parser as openmetrics
from prometheus_client.parser import text_string_to_metric_families

from gateway.clock import SystemClock
from gateway.faces.http.text import OPENMETRICS, TEXT, Format
from gateway.service.config import load_config
from gateway.service.gateway import Gateway

SITE = 'Hütte "am Joch" \\n 5'
LINE = "back\\slash\\"
DEVICE = '電池 {a="b"} #1'


@pytest.fixture
def configured(tmp_path: Path) -> Gateway:
    text = f"site = {json.dumps(SITE)}\nstate_dir = {json.dumps(str(tmp_path))}\n"
    text += f'[[line]]\nname = {json.dumps(LINE)}\nport = "{tmp_path}/tty"\n'
    text += f'[[line.device]]\nname = {json.dumps(DEVICE)}\naddress = 1\nunit_id = 11\nmodel = "prostar-mppt"\n'
    path = tmp_path / "site.toml"
    path.write_text(text, encoding="utf-8")
    return Gateway(load_config(path), SystemClock())


def scrape(gateway: Gateway, form: Format) -> bytes:
    [face] = [listener for listener in gateway.listeners if listener.label.startswith("http ")]
    exposition = face._handler.__self__._exposition  # type: ignore[attr-defined]  # the face behind its listener

    async def whole() -> bytes:
        return b"".join([piece async for piece in exposition.pieces(form)])

    return asyncio.run(whole())


@pytest.mark.parametrize("form", [TEXT, OPENMETRICS], ids=["text", "openmetrics"])
def test_parsers_read_the_names_back(configured: Gateway, form: Format) -> None:
    text = scrape(configured, form).decode()
    families: list[Metric]
    if form.openmetrics:
        families = list(openmetrics.text_string_to_metric_families(text))  # type: ignore[no-untyped-call]  # as upstream left it
    else:
        families = list(text_string_to_metric_families(text))
    samples = [sample for family in families for sample in family.samples if "site" in sample.labels]
    assert len(samples) > 40
    assert {sample.labels["site"] for sample in samples} == {SITE}
    assert {sample.labels["line"] for sample in samples if "line" in sample.labels} == {LINE}
    assert {sample.labels["device"] for sample in samples if "device" in sample.labels} == {DEVICE}


@pytest.mark.peer
def test_promtool_has_no_complaint(peer: Callable[[str], str], configured: Gateway) -> None:
    text = scrape(configured, TEXT)
    done = subprocess.run([peer("promtool"), "check", "metrics"], input=text, capture_output=True, check=False)
    assert (done.returncode, done.stdout + done.stderr) == (0, b"")
