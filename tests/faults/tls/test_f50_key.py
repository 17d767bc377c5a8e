"""F50: the server's key shows nowhere: not in logs, argv, metrics, pages, check-config, problems, nor in a folder."""

from __future__ import annotations

import base64
import re
import signal
import subprocess
from pathlib import Path

import pytest
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import load_pem_private_key

from gateway.service.config import load_config
from tests.e2e.programs import GATEWAY, REPOSITORY, Program
from tests.faces.modbus.tls.site import Pki
from tests.faults.tls.test_f48_reload import CONFIG, get, serial_at

pytestmark = pytest.mark.peer


def traces(pem: Path) -> set[str]:
    """What would give the key away: any line of the file, its number, its bytes."""
    text = pem.read_text()
    key = load_pem_private_key(text.encode(), None)
    assert isinstance(key, ec.EllipticCurvePrivateKey)
    number = key.private_numbers().private_value
    secret = number.to_bytes(32)
    lines = {line for line in text.splitlines() if not line.startswith("-----")}
    return {*lines, str(number), f"{number:x}", repr(secret)[2:-1], base64.b64encode(secret).decode()}


def test_f50_the_key_shows_nowhere(tmp_path: Path, pki: Pki) -> None:
    config = tmp_path / "site.toml"
    config.write_text(CONFIG.format(folder=tmp_path))
    given: list[str] = [repr(load_config(config)), str(load_config(config))]
    secret = traces(pki.folder / "server.key")
    program = Program([*GATEWAY, "run", "-c", str(config), "--log-level", "debug"])
    try:
        ports = {}
        for _ in range(2):
            line = program.wait_for(r'event=listening listener="(modbus tls|http) ')
            ports["tls" if "modbus tls" in line else "http"] = int(line.rpartition(":")[2])
        serial_at(ports["tls"], pki.client("operator"))
        given.append(Path(f"/proc/{program.process.pid}/cmdline").read_text())
        given.append(Path(f"/proc/{program.process.pid}/environ").read_text())

        key = (pki.folder / "server.key").read_text()
        for spoilt in (key[:120], key.replace("PRIVATE", "PUBLIC"), key.replace("\n", "", 1)):
            (pki.folder / "server.key").write_text(spoilt)
            program.process.send_signal(signal.SIGHUP)
            program.wait_for("event=tls_reload_failed kept=old")
            given += [get(ports["http"], path)[1] for path in ("/", "/readyz", "/metrics", "/healthz")]
            check = [*GATEWAY, "check-config", "-c", str(config)]
            checked = subprocess.run(check, cwd=REPOSITORY, capture_output=True, text=True, check=False)
            assert checked.returncode == 78
            assert re.search(r"site\.toml: modbus\.tls\.(key|certificate)_file: ", checked.stderr)
            given += [checked.stdout, checked.stderr]
    finally:
        assert program.end() == 0
    given.append(program.log())
    shown = "\n".join(given)
    assert "event=tls_client peer=127.0.0.1" in shown  # it did collect
    assert not [trace for trace in secret if trace in shown]
    kept = [path for path in tmp_path.rglob("*") if path.is_file() and path.parent != pki.folder]
    assert not [path for path in kept if any(trace.encode() in path.read_bytes() for trace in secret)]
