"""Settings of the history; `service/config.py` makes them from the TOML."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, slots=True)
class HistorySettings:
    """Where the history is kept, and how often controllers are asked at the latest."""

    directory: Path
    interval_s: float = 86400.0
