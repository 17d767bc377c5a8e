"""`/sd`: this gateway as a target of Prometheus' `http_sd_config`.

The target is the address by which it was asked, as the Host header says, because that is one that Prometheus can
reach: a gateway behind a name, a forwarded port or on all addresses does not know it otherwise. The label `site`
comes with it, so that `up` has it too.
"""

from __future__ import annotations

import re

Target = dict[str, list[str] | dict[str, str]]

_HOST = re.compile(r"(?P<host>\[[0-9A-Fa-f:.]{2,45}\]|[A-Za-z0-9._-]{1,253})(?::(?P<port>[0-9]{1,5}))?")


def targets(site: str, host: str, local: tuple[str, int], *, secure: bool) -> list[Target]:
    """What `/sd` answers, ready for JSON; `host` is the Host header, `local` the address that was connected to."""
    found = _HOST.fullmatch(host)
    if found is None:
        name, port = local
        address = f"[{name}]:{port}" if ":" in name else f"{name}:{port}"
    else:
        address = f"{found['host']}:{found['port'] or (443 if secure else 80)}"
    return [{"targets": [address], "labels": {"site": site, "__scheme__": "https" if secure else "http"}}]
