"""What a running gateway reads instead of the TOML is the same map, and never another's."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.devices.compiled import compiled, digest_of, restored
from gateway.devices.model import DeviceMap
from gateway.devices.schema import MAPS, compiled_map, models, read_map


def toml(model: str) -> str:
    return (MAPS / f"{model}.toml").read_text(encoding="utf-8")


def typed(value: object) -> object:
    """Everything in a value with its type: 1 and 1.0 are equal otherwise."""
    return repr(value)


@pytest.mark.parametrize("model", models())
def test_the_committed_file_is_the_map(model: str) -> None:
    text = toml(model)
    found = restored((MAPS / f"{model}.json").read_text(encoding="utf-8"), digest_of(text))
    assert found is not None, "run `prostar-gateway generate`"
    assert found == compiled_map(model, text)
    assert typed(found) == typed(compiled_map(model, text))


def test_a_small_map_comes_back(small: DeviceMap) -> None:
    found = restored(compiled(small, "text"), digest_of("text"))
    assert found == small
    assert typed(found) == typed(small)


def test_what_another_text_was_made_of_is_not_taken(small: DeviceMap) -> None:
    assert restored(compiled(small, "text"), digest_of("other")) is None


def test_what_other_classes_wrote_is_not_taken(small: DeviceMap) -> None:
    document = json.loads(compiled(small, "text"))
    document["fields"] = "0"
    assert restored(json.dumps(document), digest_of("text")) is None


@given(st.data())
def test_a_broken_file_is_none_or_an_error(small: DeviceMap, data: st.DataObject) -> None:
    written = compiled(small, "text")
    at = data.draw(st.integers(0, len(written) - 1))
    broken = written[:at] + data.draw(st.text(max_size=3)) + written[at + data.draw(st.integers(0, 3)) :]
    try:
        restored(broken, digest_of("text"))
    except ValueError:
        return


@pytest.mark.parametrize("written", ["", "[]", "{}", '{"made_of": "x"}', "null"])
def test_a_map_with_a_useless_file_beside_it_is_read_from_its_toml(tmp_path: Path, written: str) -> None:
    shutil.copy(MAPS / "prostar-mppt.toml", tmp_path)
    (tmp_path / "prostar-mppt.json").write_text(written)
    assert read_map(tmp_path / "prostar-mppt.toml") == read_map(MAPS / "prostar-mppt.toml")


def test_a_changed_toml_is_read_at_once(tmp_path: Path) -> None:
    for suffix in (".toml", ".json"):
        shutil.copy(MAPS / f"prostar-mppt{suffix}", tmp_path)
    path = tmp_path / "prostar-mppt.toml"
    text = path.read_text(encoding="utf-8")
    title = read_map(path).title
    path.write_text(text.replace(f'title = "{title}"', 'title = "Changed"'), encoding="utf-8")
    assert read_map(path).title == "Changed"
