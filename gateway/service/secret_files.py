"""Files with one secret on one line: an absolute path, or a bare name among systemd's credentials (LoadCredential=)."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator
from pathlib import Path

MOST_OCTETS = 1024


def secret_path(text: str) -> Path:
    """Where the secret is."""
    if text.startswith("/"):
        return Path(text)
    return Path(os.environ.get("CREDENTIALS_DIRECTORY", "/run/credentials/prostar-gateway.service"), text)


def read_line(text: str) -> bytes:
    """The one line of the file. OSError when it cannot be read, ValueError when it holds more."""
    with secret_path(text).open("rb") as file:
        content = file.read(MOST_OCTETS + 1)
    line = content.removesuffix(b"\n").removesuffix(b"\r")
    if len(content) > MOST_OCTETS or b"\n" in line:
        raise ValueError("holds more than one line")
    return line


def unreadable_text(text: str, error: OSError) -> str:
    """Why a file cannot be read, without a name that may be the secret itself."""
    what = text if text.startswith("/") else "the systemd credential of this name"
    return f"{what} cannot be read: {error.strerror or error}"


def open_to_all(key: str, text: str) -> Iterator[str]:
    """Advice when every user of the machine can read the file; none of one that cannot be looked at."""
    path = secret_path(text)
    try:
        mode = path.stat().st_mode
    except (OSError, ValueError):
        return
    if stat.S_ISREG(mode) and mode & 0o007:  # it is there: its name is no secret
        yield f"{key}: {path} is open to every user of this machine (mode {mode & 0o777:03o})"
