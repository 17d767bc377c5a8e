"""net-snmp's own tools against one agent: every version, level and kind of request, right and wrong credentials."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable

import pytest

from gateway.faces.snmp.agent import SnmpAgent
from gateway.faces.snmp.usm import Auth, Priv, fits
from tests.faces.snmp.poller import AUTH_PHRASE, PRIV_PHRASE, a_user
from tests.faces.snmp.stub_site import listening, run_tool

pytestmark = pytest.mark.peer

SYSTEM = "1.3.6.1.2.1.1"
PRIVATE = "PROSTAR-GATEWAY-MIB::pgwModules"
WRONG = "quite another one"


def v3(name: str, auth: str, priv: str, phrases: tuple[str, str] = (AUTH_PHRASE, PRIV_PHRASE)) -> tuple[str, ...]:
    level = ("-l", "authPriv", "-a", auth, "-A", phrases[0], "-x", priv, "-X", phrases[1])
    return ("-v", "3", "-u", name, *level)


RIGHT = {
    "v1": ("-v", "1", "-c", "public"),
    "v2c": ("-v", "2c", "-c", "public"),
    "v3": v3("noc", "SHA-256", "AES"),
}
WRONG_ONES = {
    "community": (("-v", "2c", "-c", "private"), "Timeout"),
    "v1 community": (("-v", "1", "-c", "private"), "Timeout"),
    "user": (v3("nobody", "SHA-256", "AES"), "Unknown user name"),
    "authentication key": (v3("noc", "SHA-256", "AES", (WRONG, PRIV_PHRASE)), "Authentication failure"),
    "authentication protocol": (v3("noc", "SHA-512", "AES"), "Authentication failure"),
    "SHA-1": (v3("noc", "SHA", "AES"), "Authentication failure"),
    "privacy key": (v3("noc", "SHA-256", "AES", (AUTH_PHRASE, WRONG)), "Decryption error"),
    "noAuthNoPriv": (("-v", "3", "-u", "noc", "-l", "noAuthNoPriv"), "Unsupported security level"),
    "authNoPriv": (
        ("-v", "3", "-u", "noc", "-l", "authNoPriv", "-a", "SHA-256", "-A", AUTH_PHRASE),
        "Unsupported security level",
    ),
    "context": ((*v3("noc", "SHA-256", "AES"), "-n", "elsewhere"), "Bad context"),
}

Run = Callable[..., Awaitable[tuple[int, str]]]


@pytest.fixture
async def run(
    make_agent: Callable[..., SnmpAgent], peer: Callable[[str], str], mib_path: str
) -> AsyncIterator[tuple[SnmpAgent, Run]]:
    users = [a_user("noc")]
    users += [a_user(f"{auth.label}-{priv.label}", auth, priv) for auth in Auth for priv in Priv if fits(auth, priv)]
    agent = make_agent(users=tuple(users), v1=True)
    async with listening(agent) as (host, port):

        async def tool(name: str, options: tuple[str, ...], *arguments: str) -> tuple[int, str]:
            fixed = ("-M", mib_path, "-m", "PROSTAR-GATEWAY-MIB", "-t", "5", "-r", "0")
            return await run_tool(peer(name), *fixed, *options, f"udp:{host}:{port}", *arguments)

        yield agent, tool


def cells(output: str) -> list[str]:
    return [line.partition(" = ")[0] for line in output.splitlines() if " = " in line]


async def test_every_version_reads_the_same(run: tuple[SnmpAgent, Run]) -> None:
    """get, getnext, bulkget with 1, 10, 25 and 50, walk, bulkwalk and table: what one version shows, all show."""
    _, tool = run
    table = "PROSTAR-GATEWAY-MIB::pgwLiveTable"
    first = "PROSTAR-GATEWAY-MIB::pgwBatteryVoltage.11"
    asked: dict[str, tuple[str, ...]] = {
        "snmpget": (first, f"{SYSTEM}.5.0"),
        "snmpgetnext": (first, SYSTEM),
        "snmpwalk": (table,),
        "snmptable": ("-Ci", table),
    }
    seen: dict[str, dict[str, tuple[int, str]]] = {}
    for version, options in RIGHT.items():
        found = await asyncio.gather(*(tool(name, options, *arguments) for name, arguments in asked.items()))
        seen[version] = dict(zip(asked, found, strict=True))
    for name in asked:
        assert {answers[name][0] for answers in seen.values()} == {0}, seen
        assert len({answers[name][1] for answers in seen.values()}) == 1, name
    walked = cells(seen["v1"]["snmpwalk"][1])
    assert len(walked) > 50
    assert len(set(walked)) == len(walked)
    for version in ("v2c", "v3"):
        code, output = await tool("snmpbulkwalk", RIGHT[version], table)
        assert (code, cells(output)) == (0, walked)
        bulks = await asyncio.gather(
            *(tool("snmpbulkget", RIGHT[version], f"-Cr{count}", table) for count in (1, 10, 25, 50))
        )
        for count, (code, output) in zip((1, 10, 25, 50), bulks, strict=True):
            got = cells(output)
            assert code == 0
            assert got == walked[: len(got)]
            # A reply of 1,400 octets holds about 50 of our varbinds, a secured one somewhat fewer.
            assert len(got) == count or (count == 50 and len(got) >= 40)


@pytest.mark.parametrize("version", list(RIGHT))
async def test_set_is_refused(run: tuple[SnmpAgent, Run], version: str) -> None:
    agent, tool = run
    code, output = await tool("snmpset", RIGHT[version], f"{SYSTEM}.4.0", "s", "me")
    assert code != 0
    assert ("noSuchName" if version == "v1" else "notWritable") in output
    assert agent.counters.bad_community_uses == 1


async def test_wrong_credentials_get_nothing(run: tuple[SnmpAgent, Run]) -> None:
    agent, tool = run
    wrong = [(name, (*options, "-t", "1"), said) for name, (options, said) in WRONG_ONES.items()]
    for name, arguments in (("snmpget", (f"{SYSTEM}.5.0",)), ("snmpset", (f"{SYSTEM}.4.0", "s", "me"))):
        found = await asyncio.gather(*(tool(name, options, *arguments) for _, options, _ in wrong))
        for (what, _, said), (code, output) in zip(wrong, found, strict=True):
            assert code != 0, what
            assert said in output, what
            assert "ridge" not in output, what
    assert agent.counters.responses == 0
    assert agent.counters.bad_community_names == 4


@pytest.mark.parametrize("subtree", ["1.3.6.1.6.3", "1.3.6.1.4.1.20408"])
async def test_a_walk_of_what_is_pysnmps_own_shows_nothing(run: tuple[SnmpAgent, Run], subtree: str) -> None:
    _, tool = run
    found = await asyncio.gather(*(tool("snmpwalk", options, subtree) for options in RIGHT.values()))
    for _, output in found:
        assert " = STRING" not in output
        assert " = Hex-STRING" not in output
        assert len(output.splitlines()) <= 1


async def test_every_pair_of_protocols_is_net_snmps(run: tuple[SnmpAgent, Run]) -> None:
    _, tool = run
    pairs = [(auth, priv) for auth in Auth for priv in Priv if fits(auth, priv)]
    found = await asyncio.gather(
        *(
            tool(
                "snmpget",
                v3(f"{auth.label}-{priv.label}", auth.label, priv.label.replace("AES-128", "AES")),
                f"{SYSTEM}.5.0",
            )
            for auth, priv in pairs
        )
    )
    assert [(pair, code) for pair, (code, _) in zip(pairs, found, strict=True)] == [(pair, 0) for pair in pairs]
    assert all("ridge-07" in output for _, output in found)
