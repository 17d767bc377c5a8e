"""The engine id and how often the engine started, kept where a power cut cannot lose them.

Rule 1: an engine id is never used with a number of boots that it was used with before (RFC 3414 §2.2): a start writes
        boots + 1 and only then is the socket opened. What cannot be written is not used.
Rule 2: the file is replaced whole: written beside, flushed, renamed, and the directory flushed. A crash at any step
        leaves the old content or the new.
Rule 3: a file that is missing, damaged or not writable means a new random engine id, which nobody has recorded a
        message of, or, where the operator prefers, no SNMPv3 at all. It never means boots = 1 under the old one.
Rule 4: engineTime is the monotonic clock since the start; the wall clock is not asked.
"""

from __future__ import annotations

import hashlib
import logging
import os
import re
import secrets
from dataclasses import dataclass
from pathlib import Path

from gateway.errors import GatewayError

_log = logging.getLogger(__name__)

FILE_NAME = "snmp-engine"
MAX_BOOTS = 2**31 - 1
"""snmpEngineBoots that has reached this is never in the time window again (RFC 3414 §2.2.2)."""

_FORMAT = re.compile(r"(engine_id ([0-9a-f]{10,64})\nboots ([1-9][0-9]{0,9})\n)check ([0-9a-f]{16})\n")
_OCTETS = 5
"""RFC 3411, SnmpEngineID: the octets that follow are administratively assigned."""


class EngineLost(GatewayError):
    """The engine id and boots cannot be had from `state_dir`, and the operator wants no new ones."""

    label = "snmp_engine"


@dataclass(frozen=True, slots=True)
class Engine:
    """An SNMP engine as RFC 3414 sees it: who, which start, and since when."""

    engine_id: bytes
    boots: int
    started_at: float  # monotonic

    def time(self, now: float) -> int:
        """What snmpEngineTime is at `now`, whole seconds since the start."""
        return max(0, int(now - self.started_at))


def start_engine(directory: Path | None, enterprise: int, now: float, *, renew: bool = True) -> Engine:
    """The engine of this start, its boots already on disk; `directory` None: nothing is kept.

    Raises EngineLost when nothing usable is on disk, or nothing can be written there, and `renew` is False.
    """
    if directory is None:
        return Engine(new_engine_id(enterprise), 1, now)
    path = directory / FILE_NAME
    reason = ""
    known: tuple[bytes, int] | None = None
    try:
        known = parse_state(path.read_bytes())
        if known is None:
            reason = "damaged"
    except FileNotFoundError:
        reason = "missing"
    except OSError as error:
        reason = error.strerror or str(error)
    if known is not None and known[1] >= MAX_BOOTS:
        known, reason = None, "boots used up"
    if known is None and not renew:
        raise EngineLost(f"{path}: {reason}; SNMPv3 needs its engine id and boots")
    engine_id, boots = known if known is not None else (new_engine_id(enterprise), 0)
    try:
        _replace(path, state_text(engine_id, boots + 1))
    except OSError as error:
        reason = f"not writable: {error.strerror or error}"
        if not renew:
            raise EngineLost(f"{path}: {reason}; SNMPv3 needs to count its boots") from error
        known, engine_id, boots = None, new_engine_id(enterprise), 0
    if known is None:
        # Receivers and pollers that know the old id by heart have to learn this one.
        _log.warning('event=snmp_engine_new engine_id=%s file="%s" reason="%s"', engine_id.hex(), path, reason)
    return Engine(engine_id, boots + 1, now)


def new_engine_id(enterprise: int) -> bytes:
    """A random engine id in the form of RFC 3411: enterprise number with the first bit set, form, octets."""
    return (enterprise & 0x7FFFFFFF | 0x80000000).to_bytes(4, "big") + bytes((_OCTETS,)) + secrets.token_bytes(12)


def state_text(engine_id: bytes, boots: int) -> bytes:
    """Content of the state file."""
    text = f"engine_id {engine_id.hex()}\nboots {boots}\n"
    return f"{text}check {_check(text)}\n".encode()


def parse_state(content: bytes) -> tuple[bytes, int] | None:
    """Engine id and boots of a state file, None when it is not whole."""
    found = _FORMAT.fullmatch(content.decode("ascii", "replace"))
    if found is None or _check(found[1]) != found[4] or len(found[2]) % 2 or not 1 <= int(found[3]) <= MAX_BOOTS:
        return None
    return bytes.fromhex(found[2]), int(found[3])


def _check(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _replace(path: Path, content: bytes) -> None:
    """Rule 2; raises OSError and leaves the old file."""
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    beside = path.with_name(path.name + ".new")
    handle = os.open(beside, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o600)
    try:
        written = os.write(handle, content)
        if written != len(content):
            raise OSError(28, "No space left on device")
        os.fsync(handle)
    finally:
        os.close(handle)
    beside.rename(path)
    folder = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)
