"""A secret that cannot be shown by accident.

Only `reveal()` gives it, so `grep reveal` finds every place that sees one. Text forms, formatting, pickling and JSON
show nothing of it, whatever holds the object.
"""

from __future__ import annotations

import hmac
from typing import NoReturn


class Secret:
    """Octets that only `reveal` shows."""

    __slots__ = ("_value",)

    def __init__(self, value: bytes) -> None:
        self._value = value

    def reveal(self) -> bytes:
        """The octets themselves."""
        return self._value

    def __len__(self) -> int:
        return len(self._value)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Secret) and hmac.compare_digest(self._value, other._value)

    def __hash__(self) -> int:
        return hash(self._value)

    def __repr__(self) -> str:
        return "Secret(…)"

    def __reduce__(self) -> NoReturn:
        raise TypeError("a secret is not copied or stored")
