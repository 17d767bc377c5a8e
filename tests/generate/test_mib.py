"""The generated MIB: clean for every parser, for ever the same numbers."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from pysmi.codegen import JsonCodeGen
from pysmi.compiler import MibCompiler
from pysmi.parser import SmiV2Parser
from pysmi.reader import FileReader
from pysmi.searcher import StubSearcher
from pysmi.writer import CallbackWriter

from gateway.errors import MapError
from gateway.faces.snmp.layout import Layout, shipped_layout
from gateway.faces.snmp.objects import Syntax
from gateway.generate.mib import LOCK, lock, mib_outputs
from tests.netsnmp import without_new_folders

REPOSITORY = Path(__file__).parents[2]
BASE = REPOSITORY / "mibs" / "base"
MODULES = ("PROSTAR-GATEWAY-REG-MIB", "PROSTAR-GATEWAY-TC-MIB", "PROSTAR-GATEWAY-MIB")

IETF_FOLDERS = ("usr/share/snmp/mibs/ietf", "var/lib/mibs/ietf", "usr/lib/erlang/lib/snmp-*/mibs")
"""Where a Debian machine may have the IETF's own modules: snmp-mibs-downloader (non-free) or erlang-snmp (main)."""


def base_folders() -> list[str]:
    """Our stand-ins for the IETF's modules, and the real ones where the machine has them."""
    real = [folder for pattern in IETF_FOLDERS for folder in Path("/").glob(pattern)]
    return [str(BASE), *(str(folder) for folder in real if list(folder.glob("SNMPv2-SMI*")))]


@pytest.fixture(scope="module")
def outputs() -> dict[str, str]:
    return mib_outputs(locked="")


@pytest.fixture(scope="module", params=["default", "own number"])
def folder(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Freshly written modules, under the default root and under an operator's deeper one."""
    written = tmp_path_factory.mktemp("mibs")
    root = (1, 3, 6, 1, 4, 1, 99999, 7, 2) if request.param == "own number" else shipped_layout().root
    for path, text in mib_outputs(root, locked="").items():
        (written / Path(path).name).write_text(text, encoding="utf-8")
    return written


def test_the_committed_files_are_the_generated_ones() -> None:
    for path, text in mib_outputs().items():
        assert (REPOSITORY / path).read_text(encoding="utf-8") == text, f"{path}: run `prostar-gateway generate`"


def test_the_modules_are_plain_ascii_of_a_readable_width(outputs: dict[str, str]) -> None:
    for name in MODULES:
        text = outputs[f"mibs/{name}.txt"]
        assert text.isascii()
        assert max(map(len, text.splitlines())) <= 110


@pytest.mark.peer
@pytest.mark.parametrize("module", MODULES)
@pytest.mark.parametrize("base", base_folders())
def test_smilint_has_nothing_to_say(peer: Callable[[str], str], folder: Path, base: str, module: str) -> None:
    # A module of textual conventions cannot refer to its own types, so that one warning is left out for it.
    ignored = ["-i", "type-unref"] if module == "PROSTAR-GATEWAY-TC-MIB" else []
    found = subprocess.run(
        [peer("smilint"), "-l", "6", "-s", "-m", *ignored, str(folder / f"{module}.txt")],
        env={**os.environ, "SMIPATH": f"{folder}:{base}"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (found.stdout, found.stderr) == ("", "")


@pytest.mark.peer
def test_smilint_would_say_something(peer: Callable[[str], str], folder: Path, tmp_path: Path) -> None:
    broken = (folder / "PROSTAR-GATEWAY-MIB.txt").read_text(encoding="utf-8").replace("        pgwSiteName,\n", "")
    (tmp_path / "PROSTAR-GATEWAY-MIB.txt").write_text(broken, encoding="utf-8")
    found = subprocess.run(
        [peer("smilint"), "-l", "6", "-s", "-m", str(tmp_path / "PROSTAR-GATEWAY-MIB.txt")],
        env={**os.environ, "SMIPATH": f"{folder}:{BASE}"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert "pgwSiteName" in found.stdout + found.stderr


@pytest.mark.peer
@pytest.mark.parametrize("base", base_folders())
def test_net_snmp_loads_it_without_a_word(peer: Callable[[str], str], folder: Path, base: str) -> None:
    found = subprocess.run(
        [
            peer("snmptranslate"),
            "-M",
            f"{folder}:{base}",
            "-m",
            "PROSTAR-GATEWAY-MIB",
            "-On",
            "-IR",
            "pgwBatteryVoltage",
        ],
        env={**os.environ, "SNMPCONFPATH": "/nonexistent"},
        capture_output=True,
        text=True,
        check=True,
    )
    assert without_new_folders(found.stderr) == ""
    assert found.stdout.strip().endswith(".1.2.1.4.1.9")


@pytest.mark.peer
def test_net_snmp_loads_the_repositorys_folder_as_the_readme_says(peer: Callable[[str], str]) -> None:
    found = subprocess.run(
        [peer("snmptranslate"), "-M", "mibs:mibs/base", "-m", "ALL", "PROSTAR-GATEWAY-MIB::pgwSiteName.0", "-On"],
        env={**os.environ, "SNMPCONFPATH": "/nonexistent"},
        cwd=REPOSITORY,
        capture_output=True,
        text=True,
        check=True,
    )
    assert (without_new_folders(found.stderr), found.stdout) == ("", ".1.3.6.1.4.1.32473.1.1.2.1.1.1.0\n")


@pytest.mark.peer
@pytest.mark.parametrize("base", base_folders())
@pytest.mark.parametrize(
    ("name", "number"),
    [
        ("sysName.0", "1.3.6.1.2.1.1.5.0"),
        ("sysORDescr.2", "1.3.6.1.2.1.1.9.1.3.2"),
        ("snmpInASNParseErrs.0", "1.3.6.1.2.1.11.6.0"),
        ("snmpTrapOID.0", "1.3.6.1.6.3.1.1.4.1.0"),
        ("coldStart", "1.3.6.1.6.3.1.1.5.1"),
        ("authenticationFailure", "1.3.6.1.6.3.1.1.5.5"),
    ],
)
def test_what_every_agent_serves_and_sends_has_its_name(
    peer: Callable[[str], str], base: str, name: str, number: str
) -> None:
    found = subprocess.run(
        [peer("snmptranslate"), "-M", base, "-m", "SNMPv2-MIB", "-On", f"SNMPv2-MIB::{name}"],
        env={**os.environ, "SNMPCONFPATH": "/nonexistent"},
        capture_output=True,
        text=True,
        check=True,
    )
    assert (without_new_folders(found.stderr), found.stdout) == ("", f".{number}\n")


def test_pysmi_compiles_it(folder: Path) -> None:
    compiled: dict[str, str] = {}
    compiler = MibCompiler(
        SmiV2Parser(), JsonCodeGen(), CallbackWriter(lambda name, text, _context: compiled.update({name: text}))
    )
    compiler.add_sources(FileReader(str(folder)), FileReader(str(BASE)))
    compiler.add_searchers(StubSearcher(*JsonCodeGen.baseMibs))

    statuses = compiler.compile("PROSTAR-GATEWAY-MIB")

    assert {statuses[name] for name in MODULES} == {"compiled"}
    assert '"pgwBatteryVoltage"' in compiled["PROSTAR-GATEWAY-MIB"]


def test_own_number_moves_the_modules_and_not_the_lock(outputs: dict[str, str]) -> None:
    moved = mib_outputs((1, 3, 6, 1, 4, 1, 99999, 7), locked="")
    assert "::= { pgwOrganization 7 }" in moved["mibs/PROSTAR-GATEWAY-REG-MIB.txt"]
    assert "{ enterprises 99999 }" in moved["mibs/PROSTAR-GATEWAY-REG-MIB.txt"]
    for path in ("mibs/PROSTAR-GATEWAY-TC-MIB.txt", "mibs/PROSTAR-GATEWAY-MIB.txt", LOCK):
        assert moved[path] == outputs[path]


@pytest.mark.parametrize("root", [(1, 3, 6, 1, 4, 1), (1, 3, 6, 1, 2, 1, 99)])
def test_a_root_that_is_nobodys_enterprise_is_refused(root: tuple[int, ...]) -> None:
    with pytest.raises(MapError, match=r"below 1\.3\.6\.1\.4\.1"):
        mib_outputs(root, locked="")


def without(described: Layout, table: str, column: str) -> Layout:
    tables = tuple(
        replace(each, columns=tuple(one for one in each.columns if one.name != column)) if each.name == table else each
        for each in described.tables
    )
    return replace(described, tables=tables)


def changed(described: Layout, column: str, **changes: object) -> Layout:
    tables = tuple(
        replace(
            each,
            columns=tuple(
                replace(one, **changes) if one.name == column else one  # type: ignore[arg-type]
                for one in each.columns
            ),
        )
        for each in described.tables
    )
    return replace(described, tables=tables)


def test_a_published_object_cannot_be_taken_back() -> None:
    published = lock(shipped_layout(), "")
    with pytest.raises(MapError) as refused:
        lock(without(shipped_layout(), "pgwLive", "pgwBatteryVoltage"), published)
    assert str(refused.value) == (
        "mibs/oids.lock: 1.3.6.1.4.1.32473.1.1.2.1.4.1.9 pgwBatteryVoltage Integer32 millivolts: is gone; "
        "allowed: objects are only added"
    )


@pytest.mark.parametrize(
    "changes",
    [{"name": "pgwBatteryVolts"}, {"syntax": Syntax.UNSIGNED32}, {"units": "volts"}],
    ids=["name", "syntax", "units"],
)
def test_a_published_object_cannot_become_another(changes: dict[str, object]) -> None:
    published = lock(shipped_layout(), "")
    with pytest.raises(MapError, match="pgwBatteryVoltage Integer32 millivolts: would become"):
        lock(changed(shipped_layout(), "pgwBatteryVoltage", **changes), published)


def test_a_published_object_cannot_be_renumbered() -> None:
    published = lock(shipped_layout(), "")
    with pytest.raises(MapError, match="pgwBatteryVoltage Integer32 millivolts: is gone"):
        lock(changed(shipped_layout(), "pgwBatteryVoltage", number=300), published)


def test_a_published_label_cannot_become_another() -> None:
    published = lock(shipped_layout(), "").replace("PgwChargeStateCode.nightCheck", "PgwChargeStateCode.dawn")
    with pytest.raises(MapError, match=r"PgwChargeStateCode\.1 PgwChargeStateCode\.dawn"):
        lock(shipped_layout(), published)


def test_one_name_is_one_object() -> None:
    twice = changed(shipped_layout(), "pgwArrayVoltage", name="pgwBatteryVoltage")
    with pytest.raises(MapError, match="pgwBatteryVoltage would be both"):
        lock(twice, "")


def test_new_objects_go_behind_the_published_ones() -> None:
    old = lock(without(shipped_layout(), "pgwLive", "pgwBatteryVoltage"), "")
    new = lock(shipped_layout(), old)
    assert new.startswith(old)
    assert re.fullmatch(r"\S+\.4\.1\.9 pgwBatteryVoltage Integer32 millivolts\n", new[len(old) :])


def test_the_generator_loads_no_agent() -> None:
    """docs/adr/0001: `generate` reads what a room describes, never what it does."""
    code = (
        "import sys, gateway.generate.mib as mib; mib.mib_outputs(locked='');"
        "print([name for name in ('pysnmp', 'pyasn1', 'asyncio', 'gateway.faces.snmp.agent')"
        " if name in sys.modules])"
    )
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "[]"
