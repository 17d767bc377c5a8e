"""The systemd unit and its drop-ins, by systemd's own tools; neither needs a systemd that runs."""

from __future__ import annotations

import os
import re
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.e2e.programs import GATEWAY

REPOSITORY = Path(__file__).parents[2]
FOLDER, CONFIGS = REPOSITORY / "deploy" / "systemd", REPOSITORY / "config"
UNIT = FOLDER / "prostar-gateway.service"
PROGRAM = "/opt/prostar-gateway/current/bin/prostar-gateway"
CREDENTIALS = "CREDENTIALS_DIRECTORY=/proc/${MAINPID}/root%d"
"""Where the check of a reload finds them: through the root of the gateway's own process."""
DROP_INS = [(), ("low-ports.conf",), ("credentials.conf",), ("low-ports.conf", "credentials.conf")]
WORST_EXPOSURE = 2.0

Analyze = Callable[..., "subprocess.CompletedProcess[str]"]


@pytest.fixture
def analyze(peer: Callable[[str], str], tmp_path: Path) -> Analyze:
    """`analyze(arguments, drop_ins)` runs systemd-analyze on the unit as it is installed."""
    program = peer("systemd-analyze")

    def run(
        *arguments: str, drop_ins: tuple[str, ...] = (), text: str | None = None
    ) -> subprocess.CompletedProcess[str]:
        unit = tmp_path / UNIT.name
        text = UNIT.read_text() if text is None else text
        assert PROGRAM in text
        unit.write_text(text.replace(PROGRAM, "/bin/true"))  # verify wants a program that is there
        for name in drop_ins:
            target = tmp_path / f"{UNIT.name}.d" / name
            target.parent.mkdir(exist_ok=True)
            target.write_text((FOLDER / name).read_text())
        return subprocess.run(
            [program, *arguments, str(unit)],
            capture_output=True,
            text=True,
            check=False,
            env={**os.environ, "SYSTEMD_COLORS": "0", "LC_ALL": "C.UTF-8", "SYSTEMD_UNIT_PATH": f"{tmp_path}:"},
        )

    return run


def settings(name: str) -> dict[str, list[str]]:
    """Every value of every key of a unit file."""
    found: dict[str, list[str]] = {}
    for key, value in re.findall(r"^(\w+)=(.*)$", (FOLDER / name).read_text(), re.MULTILINE):
        found.setdefault(key, []).append(value)
    return found


@pytest.mark.peer
@pytest.mark.parametrize("drop_ins", DROP_INS, ids=lambda names: " ".join(names) or "as it is")
def test_systemd_has_nothing_to_complain_about(analyze: Analyze, drop_ins: tuple[str, ...]) -> None:
    done = analyze("verify", "--man=no", drop_ins=drop_ins)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


@pytest.mark.peer
def test_a_mistake_would_be_noticed(analyze: Analyze) -> None:
    done = analyze("verify", "--man=no", text=UNIT.read_text().replace("DevicePolicy=closed", "DevicePolicy=shut"))
    assert re.search(r"Failed to parse (device policy|DevicePolicy=shut), ignoring", done.stderr)


@pytest.mark.peer
@pytest.mark.parametrize("drop_ins", DROP_INS, ids=lambda names: " ".join(names) or "as it is")
def test_its_exposure_is_small(analyze: Analyze, drop_ins: tuple[str, ...]) -> None:
    """0 is a service that can do nothing, 10 one that can do everything; docs/security.md has the number."""
    done = analyze("security", "--offline=yes", "--no-pager", drop_ins=drop_ins)
    exposure = re.search(r"Overall exposure level for \S+: ([\d.]+)", done.stdout)
    assert exposure is not None, done.stdout + done.stderr
    assert float(exposure[1]) <= WORST_EXPOSURE


def test_a_bad_configuration_is_not_tried_again() -> None:
    from gateway.cli.refusing import EX_CONFIG

    assert settings(UNIT.name)["RestartPreventExitStatus"] == [str(EX_CONFIG)]
    assert settings(UNIT.name)["Restart"] == ["always"]


def test_a_reload_that_is_refused_fails(tmp_path: Path) -> None:
    """The signal goes out first, so that the gateway counts and logs it; systemd goes by the last exit status."""
    signal, check = settings(UNIT.name)["ExecReload"]
    assert signal == '/bin/sh -c "kill -HUP $MAINPID"'
    before, program, arguments = check.partition(f" {PROGRAM} ")
    assert program
    assert before == f"/usr/bin/env {CREDENTIALS}"
    (started,) = settings(UNIT.name)["ExecStart"]
    assert arguments.split()[-2:] == started.split()[-2:]  # the same file
    for text, status in (((CONFIGS / "minimal.toml").read_text(), 0), ("site = 1\n", 78)):
        (tmp_path / "site.toml").write_text(text)
        asked = [*GATEWAY, *arguments.split()[:-1], str(tmp_path / "site.toml")]
        done = subprocess.run(asked, capture_output=True, text=True, check=False)
        assert (done.returncode, done.stdout, bool(done.stderr)) == (status, "", status != 0)


def test_a_reload_looks_for_credentials_where_the_gateway_has_them(tmp_path: Path) -> None:
    """To all other processes of the unit systemd makes /run/credentials an empty folder that nobody may open."""
    user = "\n".join(f'{key}_password_file = "noc.{key}"' for key in ("auth", "priv"))
    (tmp_path / "site.toml").write_text(
        f'{(CONFIGS / "minimal.toml").read_text()}\n[[snmp.user]]\nname = "noc"\n{user}\n'
    )
    handed_over = tmp_path / "credentials"
    name, _, place = CREDENTIALS.replace("${MAINPID}", str(os.getpid())).replace("%d", str(handed_over)).partition("=")

    def checked() -> int:
        asked = [*GATEWAY, "check-config", "--quiet", "-c", str(tmp_path / "site.toml")]
        return subprocess.run(asked, capture_output=True, check=False, env={**os.environ, name: place}).returncode

    assert checked() == 78
    handed_over.mkdir()
    for key in ("auth", "priv"):
        (handed_over / f"noc.{key}").write_text(f"{key} phrase of noc\n")
    assert checked() == 0


def test_it_opens_serial_ports_and_no_other_devices() -> None:
    unit = settings(UNIT.name)
    assert unit["DevicePolicy"] == ["closed"]
    assert unit["DeviceAllow"] == ["char-ttyUSB rw", "char-ttyACM rw", "char-ttyS rw"]
    assert "PrivateDevices" not in unit  # it would hide the ports


def test_only_the_drop_in_for_low_ports_gives_a_capability() -> None:
    assert settings(UNIT.name)["CapabilityBoundingSet"] == settings(UNIT.name)["AmbientCapabilities"] == [""]
    low = settings("low-ports.conf")
    assert low["CapabilityBoundingSet"] == low["AmbientCapabilities"] == ["CAP_NET_BIND_SERVICE"]


def test_state_lies_where_the_configuration_says_by_default() -> None:
    from gateway.service.schema import Config

    assert Config.model_fields["state_dir"].default == f"/var/lib/{settings(UNIT.name)['StateDirectory'][0]}"


def test_it_waits_for_the_gateway_to_stop_in_order() -> None:
    from gateway.service.supervisor import STOP_LINES_S, STOP_LISTENERS_S

    assert float(settings(UNIT.name)["TimeoutStopSec"][0]) > 2 * (STOP_LISTENERS_S + STOP_LINES_S)


def test_the_groups_it_is_in_are_made() -> None:
    made = re.findall(r"^g (\S+)", (FOLDER / "sysusers.conf").read_text(), re.MULTILINE)
    (groups,) = settings(UNIT.name)["SupplementaryGroups"]
    assert set(groups.split()) == {"dialout", *made}  # Debian has dialout


@pytest.mark.peer
def test_sysusers_takes_the_group(peer: Callable[[str], str], tmp_path: Path) -> None:
    (tmp_path / "etc").mkdir()
    done = subprocess.run(
        [peer("systemd-sysusers"), "--root", str(tmp_path), "-"],
        input=(FOLDER / "sysusers.conf").read_text(),
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "etc" / "group").read_text().startswith("prostar-secrets:")
    assert not (tmp_path / "etc" / "passwd").exists()


def test_the_kinds_of_ports_it_may_open_are_known_when_it_starts() -> None:
    lines = (FOLDER / "modules-load.conf").read_text().splitlines()
    assert [line for line in lines if not line.startswith("#")] == ["usbserial", "cdc_acm"]
