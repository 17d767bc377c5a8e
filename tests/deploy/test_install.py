"""deploy/install.sh from the first installation to the removal, in a folder (DESTDIR) instead of in the machine.

systemd is told nothing there: that part is tried by hand, in a container that boots a whole Debian.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.docs.blocks import ROOT, blocks
from tests.e2e.programs import Running, Start, wait_until, write_config

SCRIPT = Path("deploy") / "install.sh"
PLACED = (
    "etc/systemd/system/prostar-gateway.service",
    "etc/sysusers.d/prostar-gateway.conf",
    "etc/modules-load.d/prostar-gateway.conf",
    "etc/udev/rules.d/99-prostar-gateway.rules",
    "usr/local/bin/prostar-gateway",
)
STORY = (
    "install",
    "first-start",
    "look",
    "rehearsal",
    "",
    "rehearsal-look",
    "backup",
    "restore",
    "upgrade",
    "rollback",
    "remove",
)
"""The blocks of docs/install.md whose commands this file runs, in order, but for those of systemd and the editor, and
for what looks at the rehearsal, which tests/docs/test_blocks.py runs."""


def install(
    clone: Path, destination: Path, *arguments: str, python: str | Path = sys.executable
) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        ["bash", str(clone / SCRIPT), *arguments],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "DESTDIR": str(destination), "PYTHON": str(python)},
        umask=0o077,  # as root has it on machines that are kept tight
    )


def copy_of_the_clone(folder: Path) -> Path:
    clone = folder / "clone"
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=True).stdout.decode()
    for name in listed.split("\0"):
        if name and not name.startswith("tests/"):
            (clone / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, clone / name)
    return clone


def test_the_shell_can_read_it() -> None:
    done = subprocess.run(["bash", "-n", str(ROOT / SCRIPT)], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


def test_a_wrong_argument_shows_how_it_is_used(tmp_path: Path) -> None:
    done = install(ROOT, tmp_path, "uninstall")
    assert done.returncode == 2
    assert "deploy/install.sh remove" in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_there_is_nothing_to_go_back_to(tmp_path: Path) -> None:
    done = install(ROOT, tmp_path, "rollback")
    assert done.returncode == 1
    assert "there is no earlier release" in done.stderr


def test_what_does_not_run_any_more_is_not_gone_back_to(tmp_path: Path) -> None:
    """After an upgrade of Debian its Python may be gone."""
    home = tmp_path / "opt" / "prostar-gateway"
    for name in ("current", "previous"):
        program = home / "releases" / f"the-{name}" / "bin" / "prostar-gateway"
        program.parent.mkdir(parents=True)
        program.write_text("#!/usr/bin/python3.2\n")
        program.chmod(0o755)
        (home / name).symlink_to(f"releases/the-{name}")
    done = install(ROOT, tmp_path, "rollback")
    assert done.returncode == 1
    assert "the-previous does not run here any more" in done.stderr
    for name in ("current", "previous"):
        assert (home / name).readlink() == Path("releases", f"the-{name}")
    assert list(tmp_path.iterdir()) == [tmp_path / "opt"]


def test_removing_what_is_not_there_does_no_harm(tmp_path: Path) -> None:
    assert install(ROOT, tmp_path, "remove").returncode == 0


def test_a_release_that_cannot_be_made_leaves_nothing(tmp_path: Path) -> None:
    (tmp_path / "wheels").mkdir()
    done = install(ROOT, tmp_path / "machine", "--wheels", str(tmp_path / "wheels"))
    assert done.returncode != 0
    assert done.stderr.endswith("install.sh: no release was made; nothing was changed\n")
    assert [path for path in (tmp_path / "machine").rglob("*") if path.is_file()] == []


def test_the_page_tells_the_whole_story() -> None:
    named = [block.name for block in blocks() if block.page == "docs/install.md"]
    assert tuple(named) == STORY


@pytest.mark.long
@pytest.mark.timeout(600)
def test_from_installation_to_removal(
    tmp_path: Path, start: Start, free_tcp_port: Callable[[], int], free_udp_port: Callable[[], int]
) -> None:
    machine, clone = tmp_path / "machine", copy_of_the_clone(tmp_path)
    home, command = machine / "opt" / "prostar-gateway", str(machine / "usr/local/bin/prostar-gateway")
    config = machine / "etc" / "prostar-gateway" / "site.toml"

    def gateway(*arguments: str) -> str:
        return subprocess.run([command, *arguments], capture_output=True, text=True, check=True, cwd="/").stdout

    # Install: everything is in place, with a configuration to begin with.
    (tmp_path / "python3").symlink_to(os.path.realpath(sys.executable))
    done = install(clone, machine, python=tmp_path / "python3")
    assert done.returncode == 0, done.stderr
    (tmp_path / "python3").unlink()  # what a newer Debian calls python3 is another Python
    assert all((machine / path).exists() for path in PLACED)
    assert config.read_text() == (ROOT / "config" / "minimal.toml").read_text()
    assert "is right" in gateway("check-config", "-c", str(config))
    placed = [path for path in machine.rglob("*") if not path.is_symlink()]
    shut = [path for path in placed if ~path.stat().st_mode & (0o005 if path.is_dir() else 0o004)]
    assert shut == [], "the service is not root"
    first = home.joinpath("current").resolve()
    assert (first / "share" / "prostar-gateway" / "docs" / "install.md").is_file()
    unit = (machine / PLACED[0]).read_text()
    (started,) = re.findall(r"^ExecStart=/(\S+) run", unit, re.MULTILINE)
    assert os.access(machine / started, os.X_OK)

    # It works: a site of one's own, and a good reply from what was installed.
    start(command, "simulate", "--link-dir", str(tmp_path))
    wait_until((tmp_path / "shelter-b").exists, "the simulated lines")
    ports = (free_tcp_port(), free_udp_port(), free_tcp_port())
    write_config(tmp_path / "site.toml", ports)
    shutil.copy(tmp_path / "site.toml", config)
    site = Running(tmp_path, *ports, start(command, "run", "-c", str(config)), None)
    site.wait_online()
    assert "array-3" in site.get("/metrics")[1]
    archive = tmp_path / "backup.tar"
    assert "history.sqlite3" in gateway("backup", "-c", str(config), str(archive))
    refused = subprocess.run([command, "restore", "-c", str(config), str(archive)], capture_output=True, check=False)
    assert (refused.returncode, b"a gateway uses it" in refused.stderr) == (1, True)
    assert site.gateway.end() == 0
    assert "as ridge-07 was" in gateway("restore", "-c", str(config), str(archive))

    # Upgrade: configuration and state stay; what refuses the configuration is not switched to.
    before = config.read_text()
    project = clone / "pyproject.toml"
    project.write_text(re.sub(r'^version = ".*"$', 'version = "9.9.9"', project.read_text(), flags=re.MULTILINE))
    config.write_text(before + "nonsense = 1\n")
    done = install(clone, machine)
    assert (done.returncode, "nonsense" in done.stderr, "nothing was changed" in done.stderr) == (1, True, True)
    assert home.joinpath("current").resolve() == first
    assert [path.name for path in (home / "releases").iterdir()] == [first.name]
    config.write_text(before)
    done = install(clone, machine)
    assert done.returncode == 0, done.stderr
    assert "9.9.9" in gateway("--version")
    assert config.read_text() == before

    # Back, and forth again.
    assert install(clone, machine, "rollback").returncode == 0
    assert "9.9.9" not in gateway("--version")
    assert install(clone, machine, "rollback").returncode == 0
    assert "9.9.9" in gateway("--version")

    # Remove: configuration and state stay until they are to go, too.
    assert install(clone, machine, "remove").returncode == 0
    assert [path for path in machine.rglob("*") if path.is_file() or path.is_symlink()] == [config]
    assert install(clone, machine, "remove", "--purge").returncode == 0
    assert [path for path in machine.rglob("*") if not path.is_dir()] == []


@pytest.mark.long
@pytest.mark.timeout(600)
def test_a_machine_without_a_network(tmp_path: Path) -> None:
    """`make wheels` on one machine, `--wheels` on another one whose pip reaches nothing."""
    wheels = tmp_path / "wheels"
    download = f"{sys.executable} -m pip download --quiet --require-hashes --only-binary :all:"
    subprocess.run(f"{download} -r requirements.txt --dest {wheels}", shell=True, cwd=ROOT, check=True)
    assert "dist/wheels" in (ROOT / "Makefile").read_text()
    done = subprocess.run(
        ["bash", str(ROOT / SCRIPT), "--wheels", str(wheels)],
        capture_output=True,
        text=True,
        check=False,
        env={
            **os.environ,
            "DESTDIR": str(tmp_path / "machine"),
            "PYTHON": sys.executable,
            "PIP_CONFIG_FILE": os.devnull,
            "PIP_INDEX_URL": "http://[::1]:9/",
        },
    )
    assert done.returncode == 0, done.stderr
    command = tmp_path / "machine" / "usr" / "local" / "bin" / "prostar-gateway"
    assert b"prostar-gateway" in subprocess.run([command, "--version"], capture_output=True, check=True).stdout
