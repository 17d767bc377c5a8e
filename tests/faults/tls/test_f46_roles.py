"""F46: no role, an unknown one, two, one of another type, a long one (R-22, R-23, R-65)."""

from __future__ import annotations

import asyncio
import logging
import ssl
from pathlib import Path

import pytest
from pyasn1.codec.der import encoder
from pyasn1.type import char, univ

from gateway.core.snapshot import DeviceState
from gateway.core.write_rules import Range, WriteRule
from gateway.faces.modbus.settings import WriteSettings
from tests.faces.modbus.conftest import World, read
from tests.faces.modbus.tls.conftest import ServeTls, TlsSite
from tests.faces.modbus.tls.site import Pki, role
from tests.faces.modbus.writing import MAP, ControllerLine

pytestmark = pytest.mark.peer

PDU, REPLY = read(11, 0, 4)
WRITE = bytes.fromhex("06 E000 4B64")


async def test_f46_r23_without_a_role_every_request_is_01(serve_tls: ServeTls) -> None:
    site = await serve_tls()
    site.world.poll(12)
    reader, nobody = await site.connect("reader"), await site.connect("norole")
    for _ in range(2):  # the second time the reader's reply is remembered, and still nobody's
        assert await reader.query(12, PDU) == read(12, 0, 4)[1]
        assert await nobody.query(12, PDU) == b"\x83\x01"
    assert await nobody.query(12, b"\x2b\x0e\x01\x00") == b"\xab\x01"
    assert await nobody.query(99, PDU) == b"\x83\x01"  # it does not learn either who is there
    assert await nobody.query(12, WRITE) == b"\x86\x01"
    assert site.world.stats.refused == {"role_required": 5}


async def test_f46_without_a_role_reading_can_be_allowed(serve_tls: ServeTls) -> None:
    site = await serve_tls(tls={"require_role": False})
    nobody = await site.connect("norole")
    assert await nobody.query(11, PDU) == REPLY
    assert await nobody.query(11, WRITE) == b"\x86\x01"


async def test_f46_an_unknown_role_may_read_and_no_more(
    serve_tls: ServeTls, world: World, pki: Pki, tmp_path: Path
) -> None:
    world.device(11).map = MAP
    site = await serve_tls(writes=operators(tmp_path))
    pki.issue("gardener", extensions=[role(encoder.encode(char.UTF8String("gardener")))])
    gardener = await site.connect("gardener")
    assert await gardener.query(11, PDU) == REPLY
    assert await gardener.query(11, WRITE) == b"\x86\x01"
    assert site.world.stats.refused == {"no_write_rule": 1}


async def test_f46_r31_only_the_named_role_passes_the_rule(
    serve_tls: ServeTls, world: World, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    world.device(11).map = MAP
    site = await serve_tls(writes=operators(tmp_path))
    line = ControllerLine()
    world.set_state(11, DeviceState.ONLINE)
    site.world.device(11).line = line
    with caplog.at_level(logging.INFO):
        assert await (await site.connect("reader")).query(11, WRITE) == b"\x86\x01"
        assert site.world.stats.refused == {"no_write_rule": 1}
        assert not line.sent
        assert await (await site.connect("operator")).query(11, WRITE) == WRITE
    assert any('event=write_refused peer=127.0.0.1 role="reader" unit=11' in text for text in caplog.messages)
    assert any('event=write peer=127.0.0.1 role="operator" unit=11' in text for text in caplog.messages)


def operators(folder: Path) -> WriteSettings:
    rule = WriteRule(roles=frozenset({"operator"}), registers=(Range(0xE000, 0xE001),))
    return WriteSettings((rule,), folder)


MALFORMED = {
    "PrintableString": encoder.encode(char.PrintableString("operator")),
    "OctetString": encoder.encode(univ.OctetString(b"operator")),
    "bare bytes": b"operator",
    "empty": b"\x0c\x00",
    "10 KiB": encoder.encode(char.UTF8String("x" * 10240)),
    "4 GiB announced": b"\x0c\x84\xff\xff\xff\xff",
    "not UTF-8": b"\x0c\x02\xff\xfe",
    "a line break": encoder.encode(char.UTF8String("operator\nevent=forged")),
}


@pytest.mark.parametrize("version", [ssl.TLSVersion.TLSv1_2, ssl.TLSVersion.TLSv1_3])
@pytest.mark.parametrize("kind", MALFORMED)
async def test_f46_a_malformed_role_is_refused(
    serve_tls: ServeTls, pki: Pki, caplog: pytest.LogCaptureFixture, kind: str, version: ssl.TLSVersion
) -> None:
    site = await serve_tls()
    pki.issue("odd", extensions=[role(MALFORMED[kind])])
    await is_cut_off(site, "odd", version)
    assert site.stats.refused == {"role_malformed": 1}
    assert "forged" not in caplog.text


async def test_f46_r65_two_roles_are_refused(serve_tls: ServeTls, pki: Pki) -> None:
    site = await serve_tls()
    pki.issue_twice("two", "reader", "operator")
    await is_cut_off(site, "two")
    assert site.stats.refused == {"role_malformed": 1}


async def is_cut_off(site: TlsSite, name: str, version: ssl.TLSVersion | None = None) -> None:
    with pytest.raises((ssl.SSLError, ConnectionError, asyncio.IncompleteReadError)):
        await (await site.connect(name, version=version)).query(11, PDU)
    assert site.world.stats.requests == 0
    assert await (await site.connect("reader")).query(11, PDU) == REPLY
