"""Stored days as CSV, JSON, JSON lines or OpenMetrics, in pieces, so that ten years cost no more memory than a week.

A day in JSON has `site`, `line`, `device`, `unit_id`, `model`, `controller` (whose history it is), `hourmeter_hours`,
`written_at` (UTC, estimated) with `error_seconds` (either way), `harvested_at`, the fields of the log with their units
(columns.py), and `words`, the block as the controller holds it, in hexadecimal. CSV has the same columns; several
bits of a field are separated by blanks there. The one JSON document has `days` and `apart`.
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable, Iterator
from datetime import UTC, datetime

from gateway.core.daylog import LogFormat, Selection
from gateway.history.columns import Column, columns
from gateway.history.openmetrics import openmetrics, passes
from gateway.history.reader import HistoryReader, Owner, StoredApart, StoredDay

PIECE = 32_768
"""Characters in a piece, at least."""

_HEAD = ("site", "line", "device", "unit_id", "model", "controller")
_TIMES = ("hourmeter_hours", "written_at", "error_seconds", "harvested_at")

Progress = Callable[[int], None]


def rows_to_read(reader: HistoryReader, form: LogFormat, selection: Selection) -> int:
    """How many days an export reads in all, which is what it tells `progress`."""
    return reader.count(selection) * (passes(reader, selection) if form is LogFormat.OPENMETRICS else 1)


def export(
    reader: HistoryReader,
    form: LogFormat,
    selection: Selection,
    site: str,
    progress: Progress = lambda _rows: None,
) -> Iterator[str]:
    """The text of the export in pieces; HistoryError when the history cannot be read."""
    makers = {
        LogFormat.CSV: _csv,
        LogFormat.JSON: _json,
        LogFormat.JSONL: _json_lines,
        LogFormat.OPENMETRICS: openmetrics,
    }
    piece: list[str] = []
    size = 0
    for text in makers[form](reader, selection, site, progress):
        piece.append(text)
        size += len(text)
        if size >= PIECE:
            yield "".join(piece)
            piece, size = [], 0
    if piece:
        yield "".join(piece)


def timestamp(at: float | None) -> str | None:
    """RFC 3339 in whole seconds."""
    return None if at is None else datetime.fromtimestamp(round(at), UTC).strftime("%Y-%m-%dT%H:%M:%SZ")


def day_object(day: StoredDay, of_model: tuple[Column, ...], site: str) -> dict[str, object]:
    """A day as this file's first words say."""
    return {
        **_owner(day.owner, site),
        "hourmeter_hours": day.hourmeter,
        "written_at": timestamp(day.written_at),
        "error_seconds": None if day.error_s is None else round(day.error_s),
        "harvested_at": timestamp(day.harvested_at),
        **{column.name: column.show(day.values) for column in of_model},
        "words": day.words.hex(),
    }


def _owner(owner: Owner, site: str) -> dict[str, object]:
    values = (owner.site or site, owner.line, owner.device, owner.unit_id, owner.model, owner.identity)
    return dict(zip(_HEAD, values, strict=True))


def _apart_object(block: StoredApart, site: str) -> dict[str, object]:
    return {
        **_owner(block.owner, site),
        "hourmeter_hours": block.hourmeter,
        "slot": block.slot,
        "why": block.why,
        "words": block.words.hex(),
    }


def _objects(reader: HistoryReader, selection: Selection, site: str, progress: Progress) -> Iterator[dict[str, object]]:
    of_models = {model: columns(model) for model in reader.models(selection)}
    for day in reader.days(selection):
        progress(1)
        yield day_object(day, of_models[day.owner.model], site)


def _json_lines(reader: HistoryReader, selection: Selection, site: str, progress: Progress) -> Iterator[str]:
    for found in _objects(reader, selection, site, progress):
        yield json.dumps(found, ensure_ascii=False) + "\n"


def _json(reader: HistoryReader, selection: Selection, site: str, progress: Progress) -> Iterator[str]:
    yield '{"days": ['
    separator = "\n"
    for found in _objects(reader, selection, site, progress):
        yield separator + json.dumps(found, ensure_ascii=False)
        separator = ",\n"
    yield '\n],\n"apart": ['
    separator = "\n"
    for block in reader.apart(selection):
        yield separator + json.dumps(_apart_object(block, site), ensure_ascii=False)
        separator = ",\n"
    yield "\n]}\n"


def _csv(reader: HistoryReader, selection: Selection, site: str, progress: Progress) -> Iterator[str]:
    fields = dict.fromkeys(column.name for model in reader.models(selection) for column in columns(model))
    buffer = io.StringIO()
    writer = csv.DictWriter(buffer, [*_HEAD, *_TIMES, *fields, "words"], restval="", lineterminator="\r\n")
    writer.writeheader()
    for found in _objects(reader, selection, site, progress):
        writer.writerow({name: " ".join(cell) if isinstance(cell, list) else cell for name, cell in found.items()})
        yield _drain(buffer)
    yield _drain(buffer)


def _drain(buffer: io.StringIO) -> str:
    text = buffer.getvalue()
    buffer.seek(0)
    buffer.truncate()
    return text
