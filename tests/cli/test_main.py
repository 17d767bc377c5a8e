"""Signals before and while the commands are loaded."""

from __future__ import annotations

import ast
import signal
import sys
from pathlib import Path

import pytest

from gateway.cli import main as module


@pytest.mark.parametrize(
    ("arguments", "number", "status"),
    [
        (["run", "-c", "x"], signal.SIGTERM, 0),
        (["demo"], signal.SIGINT, 0),
        (["simulate"], signal.SIGINT, 0),
        (["generate", "--check"], signal.SIGINT, 130),
        (["check-config"], signal.SIGTERM, 143),
        ([], signal.SIGINT, 130),
    ],
)
def test_a_signal_ends_it_quietly(
    monkeypatch: pytest.MonkeyPatch, arguments: list[str], number: signal.Signals, status: int
) -> None:
    monkeypatch.setattr(sys, "argv", ["prostar-gateway", *arguments])
    with pytest.raises(SystemExit) as left:
        module._leave(number, None)
    assert left.value.code == status


def test_nothing_slow_is_imported_before_the_signals_are_handled() -> None:
    tree = ast.parse(Path(module.__file__).read_text())
    top = {
        alias.name if isinstance(node, ast.Import) else node.module
        for node in tree.body
        if isinstance(node, ast.Import | ast.ImportFrom)
        for alias in node.names
    }
    assert top <= {"__future__", "signal", "sys", "types"}
