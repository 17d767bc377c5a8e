"""A real snmptrapd with the delivered configuration gets what the gateway tells, in every way that there is."""

from __future__ import annotations

import asyncio
import os
import re
from collections.abc import Callable
from pathlib import Path

import pytest

from gateway.devices.schema import load_map
from gateway.faces.snmp.secret import Secret
from gateway.faces.snmp.settings import Receiver
from gateway.generate.mib import mib_outputs
from tests.deploy.nms.conftest import COMMUNITY
from tests.faces.snmp.poller import AUTH_PHRASE, PRIV_PHRASE, credentials
from tests.faces.snmp.stub_site import REPOSITORY
from tests.faces.snmp.test_traps import Gateway

pytestmark = pytest.mark.peer


def configured(text: str, engine_id: bytes, handler: Path) -> str:
    """The delivered file with credentials, engine id and one of its handlers."""
    text = text.replace("CHANGE-ME", COMMUNITY).replace("ENGINE-ID", engine_id.hex())
    text = text.replace("CHANGE-AUTH", AUTH_PHRASE).replace("CHANGE-PRIV", PRIV_PHRASE)
    text = text.replace(
        "# traphandle PROSTAR-GATEWAY-MIB::pgwConditionRaised", "traphandle PROSTAR-GATEWAY-MIB::pgwConditionRaised"
    )
    assert "CHANGE" not in text
    return text.replace("/usr/local/sbin/tell-somebody", str(handler))


@pytest.mark.parametrize("way", [("trap", "v2c"), ("inform", "v2c"), ("trap", "v3"), ("inform", "v3")], ids="-".join)
async def test_it_writes_a_line_and_calls_the_handler(
    peer: Callable[[str], str],
    delivered: Callable[[str], str],
    free_udp_port: Callable[[], int],
    tmp_path: Path,
    way: tuple[str, str],
) -> None:
    kind, version = way
    port = free_udp_port()
    receiver = Receiver(
        "127.0.0.1",
        port,
        inform=kind == "inform",
        community=Secret(COMMUNITY.encode()) if version == "v2c" else None,
        credentials=credentials() if version == "v3" else None,
        hold_s=0.0,
    )
    gateway = Gateway(load_map("prostar-mppt"), (receiver,), tmp_path / "state")
    for path, text in mib_outputs(locked="").items():
        (tmp_path / Path(path).name).write_text(text, encoding="utf-8")
    handler, handled = tmp_path / "handler", tmp_path / "handled"
    handler.write_text(f"#!/bin/sh\ncat > {handled}.new && mv {handled}.new {handled}\n")
    handler.chmod(0o755)
    config = tmp_path / "snmptrapd.conf"
    config.write_text(configured(delivered("snmptrapd.conf"), gateway.agent.engine().engine_id, handler))
    process = await asyncio.create_subprocess_exec(
        *(peer("snmptrapd"), "-f", "-Lo", "-C", "-c", str(config), "-m", "ALL"),
        *("-M", f"{tmp_path}:{REPOSITORY / 'mibs' / 'base'}", f"udp:127.0.0.1:{port}"),
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.STDOUT,
        env={**os.environ, "SNMP_PERSISTENT_DIR": str(tmp_path), "SNMPCONFPATH": str(tmp_path), "TZ": "UTC"},
    )
    assert process.stdout is not None
    try:
        async with asyncio.timeout(30):
            while b"NET-SNMP version" not in (line := await process.stdout.readline()):
                assert line, "snmptrapd ended"
            async with gateway.running():
                gateway.shows(array_faults=1 << 3)
                while b"pgwConditionRaised" not in (line := await process.stdout.readline()):
                    assert line, "snmptrapd ended"
            while not handled.exists():  # noqa: ASYNC110 - another program makes it
                await asyncio.sleep(0.02)
    finally:
        process.terminate()
        await process.wait()
    text = line.decode()
    assert re.match(r"\d{4}-\d{2}-\d{2} \d{2}:\d{2}:\d{2} UDP: \[127\.0\.0\.1\]", text)
    for object_ in (
        'pgwSiteName.0 = STRING: "?ridge-07',
        "pgwConditionName.11.103 = ",
        "pgwConditionState.11.103 = INTEGER: raised",
    ):
        assert re.search(object_, text), text
    assert "array_fault_battery_hvd" in handled.read_text()
