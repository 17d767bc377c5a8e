"""The models that have a map, and their maps.

Rule 1: a map is written in `maps/<model>.toml` and nowhere else. `generate` commits what forms.py makes of it as
        `maps/<model>.json` (compiled.py), which is read in a tenth of the time and without the library for forms.
Rule 2: that is only ever used for the very TOML it was made of: where it is missing, made of another one or cannot be
        read, the TOML is read.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path

from gateway.devices.compiled import digest_of, restored
from gateway.devices.model import DeviceMap
from gateway.errors import MapError

MAPS = Path(__file__).parent / "maps"


def models() -> tuple[str, ...]:
    """The models that have a map, in alphabetical order."""
    return tuple(sorted(path.stem for path in MAPS.glob("*.toml")))


@cache
def load_map(model: str) -> DeviceMap:
    """The map of a model; MapError when there is none of that name or it is wrong."""
    if model not in models():
        raise MapError(f"no map for model {model!r}; known: {', '.join(models())}")
    return read_map(MAPS / f"{model}.toml")


def read_map(path: Path) -> DeviceMap:
    """The map in a TOML file, or what was made of it; MapError when it is wrong."""
    text = path.read_text(encoding="utf-8")
    try:
        found = restored(path.with_suffix(".json").read_text(encoding="utf-8"), digest_of(text))
    except (OSError, ValueError):
        found = None
    return compiled_map(path.stem, text) if found is None else found


def compiled_map(model: str, text: str) -> DeviceMap:
    """The map that a TOML text is; MapError when it is wrong, or of another model."""
    from gateway.devices.forms import parse_map  # noqa: PLC0415 - rule 1: 12 MiB that a gateway need not have

    device_map = parse_map(text, f"{model}.toml")
    if device_map.model != model:
        raise MapError(f"{model}.toml: model: is {device_map.model!r}, the file says {model!r}")
    return device_map
