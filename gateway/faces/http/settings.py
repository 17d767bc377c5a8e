"""Settings of the HTTP face; `service/config.py` makes them from the TOML."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class HttpSettings:
    """Where to listen, and how much patience strangers get."""

    listen: tuple[tuple[str, int], ...] = (("127.0.0.1", 9850),)
    max_connections: int = 16  # per listener; over it the oldest one that has no request under way is closed
    idle_timeout_s: float = 5.0  # time for a request's header, and between two requests of a connection
    stop_grace_s: float = 1.0  # how long a stopping listener waits for replies under way
    send_timeout_s: float = 30.0  # time for a scraper to take a whole reply
    basic_auth_file: str = ""  # lines of name:password; "" for none
    bearer_token_file: str = ""  # one token; "" for none
    tls_certificate: str = ""  # PEM; "" for plain HTTP
    tls_private_key: str = ""
