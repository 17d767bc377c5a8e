"""The udev rules, run by udevadm over an FTDI adapter that umockdev makes up (ftdi.umockdev), beside Debian's own.

`udevadm test` reads the rules of this machine. So it runs in a mount namespace of its own, where /run/udev holds
nothing and /etc/udev/rules.d nothing but the rules under test; the machine's own, an installed gateway's too, are
neither touched nor read.
"""

from __future__ import annotations

import os
import re
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

RULES = Path(__file__).parents[2] / "deploy" / "udev" / "99-prostar-gateway.rules"
ADAPTER = Path(__file__).with_name("ftdi.umockdev")
USB = "/sys/devices/pci0000:00/0000:00:14.0/usb1/1-2"
PORT = f"{USB}/1-2:1.0/ttyUSB0"
TTY = f"{PORT}/tty/ttyUSB0"
BRLTTY = 'SUBSYSTEM=="usb", ENV{PRODUCT}=="403/6001/*", TAG+="systemd", ENV{SYSTEMD_WANTS}+="brltty-udev.service"\n'
"""What brltty's rules come down to for an adapter that they take for a braille display."""

WRITES = (
    r"ATTR '(?P<path>\S+)' writing '(?P<value>\S+)'$",  # 252, Debian 12: it says so and does not
    r'Running in test mode, skipping writing ATTR\{(?P<path>\S+)\}="(?P<value>\S+)"\.$',  # 257, Debian 13
    r'ATTR\{(?P<path>\S+)\}="\S+": Running in test mode, skipping writing "(?P<value>\S+)" to sysfs',  # 262
)
"""What udevadm of each systemd says of an attribute that a rule writes."""
LINKS = (r"LINK '", "Added SYMLINK ", r'SYMLINK\+="\S+": Added device node symlink ')
"""As `WRITES`, of a name that a rule gives."""

Udev = Callable[..., str]

pytestmark = pytest.mark.peer


@pytest.fixture
def udev(peer: Callable[[str], str], tmp_path: Path) -> Udev:
    """`udev(device, rules)` is all that udevadm says about that device with these rules."""
    udevadm, mock = peer("udevadm"), peer("umockdev-run")
    if os.geteuid():
        pytest.skip("a mount namespace takes root")

    def run(device: str, rules: str, others: str = "") -> str:
        folder = tmp_path / "rules.d"
        folder.mkdir(exist_ok=True)
        (folder / RULES.name).write_text(rules)
        (folder / "90-others.rules").write_text(others)
        place = f"mkdir -p /run/udev && mount -t tmpfs none /run/udev && mount --bind {folder} /etc/udev/rules.d"
        done = subprocess.run(
            ["unshare", "--mount", "sh", "-c", f"{place} && {mock} -d {ADAPTER} -- {udevadm} test {device}"],
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        return done.stdout + done.stderr

    return run


def properties(shown: str) -> dict[str, str]:
    return dict(re.findall(r"^ *([A-Z]\w*)=(.*)$", shown, re.MULTILINE))


def complaints(shown: str) -> list[str]:
    """What udev says about the rules themselves."""
    about = re.findall(rf"{RULES.name}:\d+ (.*)", shown)
    return [said for said in about if not any(re.match(done, said) for done in (*WRITES, *LINKS))]


def named() -> str:
    """The rules with the two example names in use."""
    text, count = re.subn(r'^#(SUBSYSTEM=="tty")', r"\1", RULES.read_text(), flags=re.MULTILINE)
    assert count == 2
    return text


def test_udev_has_nothing_to_complain_about(udev: Udev) -> None:
    for device in (USB, PORT, TTY):
        assert complaints(udev(device, named())) == []


def test_a_mistake_would_be_noticed(udev: Udev) -> None:
    assert complaints(udev(TTY, named().replace('ENV{ID_PATH}=="', 'ENV{ID_PATH}="="', 1))) != []


def test_modem_manager_is_kept_away(udev: Udev) -> None:
    assert properties(udev(USB, RULES.read_text()))["ID_MM_DEVICE_IGNORE"] == "1"
    assert properties(udev(TTY, RULES.read_text()))["ID_MM_PORT_IGNORE"] == "1"
    assert "ID_MM_PORT_IGNORE" not in properties(udev(TTY, ""))


def test_brltty_is_kept_away(udev: Udev) -> None:
    assert properties(udev(USB, "", BRLTTY))["SYSTEMD_WANTS"] == "brltty-udev.service"
    assert properties(udev(USB, RULES.read_text(), BRLTTY)).get("SYSTEMD_WANTS", "") == ""
    others = BRLTTY.replace("brltty-udev", "something")
    assert properties(udev(USB, RULES.read_text(), others))["SYSTEMD_WANTS"] == "something.service"


def test_an_ftdi_adapter_hands_on_at_once_what_it_received(udev: Udev) -> None:
    shown = udev(PORT, RULES.read_text())
    written = [found.group("path", "value") for form in WRITES for found in re.finditer(form, shown, re.MULTILINE)]
    assert written in ([(f"{PORT}/latency_timer", "1")], [("latency_timer", "1")])


@pytest.mark.parametrize("name", ["prostar-shelter-a", "prostar-shelter-b"], ids=["by serial number", "by socket"])
def test_a_port_has_a_name_of_its_own(udev: Udev, name: str) -> None:
    assert f"/dev/{name}" in properties(udev(TTY, named()))["DEVLINKS"].split()
    assert f"/dev/{name}" not in properties(udev(TTY, RULES.read_text()))["DEVLINKS"].split()
