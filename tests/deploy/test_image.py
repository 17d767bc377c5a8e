"""The image, built and run by the commands of docs/container.md as they are printed there, by podman."""

from __future__ import annotations

import os
import re
import shutil
import socket
import subprocess
import sys
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.deploy.podman import Podman
from tests.docs.blocks import ROOT, blocks
from tests.e2e.programs import Program, children_of, wait_until
from tests.ports import free_port

PAGE = "docs/container.md"
BLOCKS = {block.name: block for block in blocks() if block.page == PAGE}
STORY = ("image-build", "image-check", "image-run", "image-look", "image-service")
DIALOUT = 20
USER = 10001

CONFIG = """
site = "ridge-07"
[[line]]
name = "shelter-a"
port = "{pty}"
baudrate = 115200
[[line.device]]
name = "array-1"
address = 1
unit_id = 11
model = "prostar-mppt"
[modbus]
listen = ["127.0.0.1:{modbus}"]
[http]
listen = ["127.0.0.1:{http}"]
[snmp]
listen = ["127.0.0.1:{snmp}"]
[[snmp.user]]
name = "noc"
auth_password_file = "/etc/prostar-gateway/noc.secret"
priv_password_file = "/etc/prostar-gateway/noc.secret"
"""


def test_the_page_tells_the_whole_story() -> None:
    assert tuple(BLOCKS) == STORY


@pytest.fixture
def podman(peer: Callable[[str], str], tmp_path: Path) -> Iterator[Podman]:
    if os.geteuid() != 0:
        pytest.skip("needs root")
    peer("crun")
    peer("catatonit")
    made = Podman(peer("podman"), tmp_path)
    try:
        made.base(peer("debootstrap"))
        yield made
    finally:
        made.close()


@pytest.fixture
def line(tmp_path: Path) -> Iterator[Path]:
    """A simulated line on a pty that belongs to the group of serial ports."""
    program = Program((sys.executable, "-m", "tests.e2e.fast_lines", str(tmp_path), "plants"))
    wait_until((tmp_path / "shelter-b").exists, "the simulated lines")
    pty = (tmp_path / "shelter-a").resolve()
    shutil.chown(pty, group=DIALOUT)
    pty.chmod(0o660)
    yield pty
    program.end()


def clone(folder: Path) -> Path:
    """The repository as somebody else has it: what git knows, and nothing that lies about."""
    made = folder / "clone"
    made.mkdir()
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=True).stdout.decode()
    for name in filter(None, listed.split("\0")):
        (made / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(ROOT / name, made / name)
    return made


@pytest.mark.long
@pytest.mark.peer
@pytest.mark.timeout(900)
def test_the_image_is_built_and_runs_as_the_page_says(podman: Podman, line: Path, tmp_path: Path) -> None:
    etc = tmp_path / "etc"
    etc.mkdir()
    tmp_path.chmod(0o711)
    config, secret = etc / "site.toml", etc / "noc.secret"
    http = free_port(socket.SOCK_STREAM)
    ports = {"modbus": free_port(socket.SOCK_STREAM), "snmp": free_port(socket.SOCK_DGRAM), "http": http}
    config.write_text(CONFIG.format(pty=line, **ports))
    secret.write_text("correct-horse-1")
    os.chown(secret, USER, USER)
    secret.chmod(0o400)

    def block(name: str) -> str:
        text = BLOCKS[name].text.replace("-v /etc/prostar-gateway:", f"-v {etc}:")
        text = text.replace("podman build ", f"podman build {podman.trust()} ")
        done = podman.sh(text, tmp_path / "clone")
        return done.stdout + done.stderr

    def asked(path: str) -> str:
        with urllib.request.urlopen(f"http://127.0.0.1:{http}{path}", timeout=60) as reply:
            return str(reply.read().decode())

    def log() -> str:
        return podman("logs prostar-gateway 2>&1")

    def online(site: str) -> bool:
        try:
            return re.search(rf'^morningstar_up{{.*site="{site}".*}} 1.0$', asked("/metrics"), re.MULTILINE) is not None
        except OSError:
            return False

    # Built of a clone: small, without what installs, and not for root.
    clone(tmp_path)
    block("image-build")
    about = podman("inspect --format '{{.User}} {{.Config.StopSignal}} {{.HealthCheck.Test}}' prostar-gateway")
    user, signal_, *check = about.split()
    assert (user, signal_) == (str(USER), "SIGTERM")
    assert "health" in check
    inside = podman(
        "run --rm --entrypoint sh prostar-gateway -c 'du -sm /opt/prostar-gateway; ls /opt/prostar-gateway/bin'"
    )
    assert int(inside.split()[0]) < 100
    assert "prostar-gateway" in inside.split()
    assert not {"pip", "pip3"} & set(inside.split())

    # Run as the page says, it serves and has no privilege.
    assert "is right." in block("image-check")
    block("image-run")
    wait_until(lambda: online("ridge-07"), "the first values")
    assert asked("/readyz") == "ready\n"
    init = int(podman("inspect --format '{{.State.Pid}}' prostar-gateway"))
    [gateway] = children_of(init)
    status = Path(f"/proc/{gateway}/status").read_text()
    assert re.search(rf"^Uid:(\t{USER}){{4}}$", status, re.MULTILINE)
    assert set(re.findall(r"^Cap(?:Prm|Eff|Bnd|Amb):\t(\w+)$", status, re.MULTILINE)) == {"0" * 16}
    assert re.search(r"^NoNewPrivs:\t1$", status, re.MULTILINE)
    shown = block("image-look")
    assert shown.count("event=started") == 1
    assert "/healthz: ok" in shown
    assert "nobody so far" in shown
    assert shown.count("event=snmp_engine_new") == 1

    # A reload is a signal, and leaves no process behind.
    config.write_text(config.read_text().replace("ridge-07", "ridge-08"))
    podman("kill -s HUP prostar-gateway")
    wait_until(lambda: online("ridge-08"), "the new name")
    assert children_of(init) == [gateway]
    assert children_of(gateway) == []
    config.write_text("nonsense = 1\n" + config.read_text())
    podman("kill -s HUP prostar-gateway")
    wait_until(lambda: "event=reload_refused" in log(), "the refusal")
    podman("exec prostar-gateway prostar-gateway health -c /etc/prostar-gateway/site.toml")
    config.write_text(config.read_text().replace("nonsense = 1\n", ""))

    # It stops in order; what it knows is there for the next one.
    archive = "/var/lib/prostar-gateway/pg.tar"  # with Docker nothing else is writable
    podman(f"exec prostar-gateway prostar-gateway backup -c /etc/prostar-gateway/site.toml {archive}")
    podman(f"cp prostar-gateway:{archive} backup.tar")
    assert "history.sqlite3" in podman.sh("tar -tf backup.tar", tmp_path).stdout
    podman("stop prostar-gateway")
    assert podman("inspect --format '{{.State.ExitCode}}' prostar-gateway") == "0"
    assert [log().count(f"event={event}") for event in ("stopping", "stopped status=0")] == [1, 1]
    podman("rm prostar-gateway")
    block("image-run")
    wait_until(lambda: online("ridge-08"), "the values of the next one")
    assert "event=snmp_engine_new" not in log()

    # One that hangs is found out.
    os.kill(children_of(int(podman("inspect --format '{{.State.Pid}}' prostar-gateway")))[0], 19)
    assert "unhealthy" in podman.sh("podman healthcheck run prostar-gateway", tmp_path, check=False).stdout
    podman("rm --force --time 0 prostar-gateway")

    # A folder of somebody else is said, and so is a configuration that is not there.
    (tmp_path / "roots").mkdir()
    volumes = f"-v {etc}:/etc/prostar-gateway:ro -v {tmp_path}/roots:/var/lib/prostar-gateway"
    podman(f"run -d --name other --network host {volumes} prostar-gateway")
    wait_until(
        lambda: f"belongs to uid 0, and uid {USER} may not write there" in podman("logs other 2>&1"),
        "whose folder it is",
    )
    podman("rm --force other")
    bare = podman.sh("podman run --rm --init --network host prostar-gateway", tmp_path, check=False)
    assert bare.returncode == 78
    assert "site.toml: cannot be read: No such file or directory" in bare.stderr
