"""The maps as a running gateway reads them (devices/compiled.py)."""

from __future__ import annotations

from gateway.devices.compiled import compiled
from gateway.devices.schema import MAPS, compiled_map, models


def map_outputs() -> dict[str, str]:
    """One file a model, by path from the repository."""
    texts = {model: (MAPS / f"{model}.toml").read_text(encoding="utf-8") for model in models()}
    return {
        f"gateway/devices/maps/{model}.json": compiled(compiled_map(model, text), text) for model, text in texts.items()
    }
