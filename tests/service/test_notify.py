"""`[[snmp.notify]]`: what is refused, what is advised, and what the face is given."""

from __future__ import annotations

from pathlib import Path

import pytest

from gateway.core.conditions import Severity
from gateway.errors import ConfigError
from gateway.faces.snmp.secret import Secret
from gateway.service.advice import advice
from gateway.service.config import parse_config
from gateway.service.gateway import Gateway
from gateway.service.settings import line_budgets
from gateway.service.snmp import snmp_settings, unreadable
from tests.faces.snmp.stub_site import StubClock
from tests.service.test_config import MINIMAL


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name, content in {"auth": "authentic phrase", "priv": "private phrase", "community": "k7-traps"}.items():
        (tmp_path / name).write_text(content + "\n")
        (tmp_path / name).chmod(0o600)
    return tmp_path


def text(folder: Path, *tables: str) -> str:
    user = f'[[snmp.user]]\nname = "noc"\nauth_password_file = "{folder}/auth"\npriv_password_file = "{folder}/priv"\n'
    receivers = "".join(f"[[snmp.notify]]\n{table}\n" for table in tables)
    return f'{MINIMAL}[snmp]\nenterprise_root = "1.3.6.1.4.1.12345.1"\n{user}{receivers}'


def table(address: str = "192.0.2.7:162", **keys: object) -> str:
    lines = [f'address = "{address}"']
    lines += [f'{key} = "{value}"' if isinstance(value, str) else f"{key} = {value}" for key, value in keys.items()]
    return "\n".join(lines)


def problems(written: str) -> list[str]:
    with pytest.raises(ConfigError) as refused:
        parse_config(written)
    return [problem.removeprefix("config: ") for problem in refused.value.problems]


def advised(written: str) -> tuple[str, ...]:
    config = parse_config(written)
    return advice(config, line_budgets(config))


def test_receivers_become_what_the_face_wants(folder: Path) -> None:
    written = text(
        folder,
        table(user="noc"),
        table(
            "[2001:db8::7]:1162",
            kind="trap",
            community_file=f"{folder}/community",
            severity="critical",
            hold_s=5.0,
            per_minute=10.0,
        ),
    )
    settings = snmp_settings(parse_config(written))
    one, two = settings.receivers
    assert (one.host, one.port, one.inform, one.community, one.least) == ("192.0.2.7", 162, True, None, Severity.INFO)
    assert one.credentials is settings.users[0].credentials
    assert (one.hold_s, one.per_minute, one.label) == (30.0, 60.0, "192.0.2.7:162")
    assert (two.inform, two.community, two.credentials) == (False, Secret(b"k7-traps"), None)
    assert (two.least, two.hold_s, two.per_minute, two.label) == (Severity.CRITICAL, 5.0, 10.0, "[2001:db8::7]:1162")
    assert not settings.authentication_traps


@pytest.mark.parametrize(
    ("keys", "problem"),
    [
        ({}, "snmp.notify[0]: neither user nor community_file is there; allowed: one of the two"),
        (
            {"user": "noc", "community_file": "/x"},
            "snmp.notify[0]: both user and community_file are there; allowed: one of the two",
        ),
        ({"user": "noc2"}, 'snmp.notify[0].user: there is no user "noc2"; allowed: "noc"'),
        ({"user": "noc", "kind": "Trap"}, 'snmp.notify[0].kind: "Trap" is not allowed; allowed: "trap" or "inform"'),
        ({"user": "noc", "hold_s": -1.0}, "snmp.notify[0].hold_s: -1.0 is out of range; allowed: 0.0 to 86400.0"),
        ({"user": "noc", "severity": "bad"}, 'snmp.notify[0].severity: "bad" is not allowed; allowed: "info", '),
        ({"user": "noc", "port": 162}, "snmp.notify[0].port: unknown key; allowed: address, kind, user,"),
    ],
)
def test_a_wrong_table_is_named(folder: Path, keys: dict[str, object], problem: str) -> None:
    [found] = problems(text(folder, table(**keys)))  # type: ignore[arg-type]
    assert found.startswith(problem)


@pytest.mark.parametrize(
    "address", ["192.0.2.7", "nms.example.net:162", "0.0.0.0:162", "[::]:162", "192.0.2.7:0", "224.0.0.1:162"]
)
def test_an_address_where_nobody_is_is_refused(folder: Path, address: str) -> None:
    [found] = problems(text(folder, table(address, user="noc")))
    assert found.startswith(f'snmp.notify[0].address: "{address}" is not allowed; allowed: an IP address with a port')


@pytest.mark.parametrize("content", ["", "two words", "x" * 33, "one\ntwo", "ü"])
def test_a_file_without_a_community_is_refused_and_not_shown(folder: Path, content: str) -> None:
    (folder / "community").write_text(content)
    [found] = problems(text(folder, table(community_file=f"{folder}/community")))
    assert found.startswith("snmp.notify[0].community_file: holds ")
    assert found.endswith("; allowed: one line of 1 to 32 printable ASCII characters without blanks")
    assert not content or content not in found


def test_one_receiver_is_told_once(folder: Path) -> None:
    [found] = problems(text(folder, table(user="noc"), table(user="noc", kind="trap")))
    assert found.startswith("snmp.notify[1]: is the same receiver with the same name again")
    parse_config(text(folder, table(user="noc"), table(community_file=f"{folder}/community")))


def test_a_community_that_cannot_be_read_is_advice_first_and_a_problem_at_the_start(folder: Path) -> None:
    written = text(folder, table("127.0.0.1:162", community_file="/nonexistent/community"))
    reason = "snmp.notify[0].community_file: /nonexistent/community cannot be read: No such file or directory"
    assert advised(written) == (f"{reason}; the gateway will not start without it",)
    config = parse_config(written)
    assert list(unreadable(config)) == [reason]
    with pytest.raises(ConfigError, match="cannot be read"):
        snmp_settings(config)


def test_advice(folder: Path) -> None:
    (folder / "community").chmod(0o644)
    assert advised(text(folder, table(community_file=f"{folder}/community"))) == (
        "snmp.notify[0].community_file: SNMP v2c sends the community and all else in clear to 192.0.2.7:162",
        f"snmp.notify[0].community_file: {folder}/community is open to every user of this machine (mode 644)",
    )
    assert advised(text(folder, table(user="noc"))) == ()
    alone = advised(f"{MINIMAL}[snmp]\nauthentication_traps = true\n")
    assert "snmp.authentication_traps: there is no [[snmp.notify]], so nobody is told" in alone


def test_a_gateway_that_only_sends_needs_its_own_number_too(folder: Path) -> None:
    receiver = table("127.0.0.1:162", community_file=f"{folder}/community")
    assert any("32473" in each for each in advised(f"{MINIMAL}[[snmp.notify]]\n{receiver}\n"))


def test_the_gateway_runs_what_is_configured(folder: Path) -> None:
    config = parse_config(
        f"{text(folder, table(user='noc'))}\n".replace("site =", f'state_dir = "{folder}"\nsite =', 1)
    )
    assert "notifications" in [keeper.name for keeper in Gateway(config, StubClock()).keepers]
