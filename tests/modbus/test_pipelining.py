"""How many requests a server is given at once."""

from __future__ import annotations

from gateway.modbus.pipelining import FIRST_HOLD_S, FORGET_S, LAST_HOLD_S, Window


def widths(window: Window, replies: int, now: float = 0.0) -> list[int]:
    seen: list[int] = []
    for _ in range(replies):
        window.answered(now)
        if not seen or seen[-1] != window.size:
            seen.append(window.size)
    return seen


def test_it_doubles_with_every_window_of_replies_up_to_what_is_configured() -> None:
    assert widths(Window(8), 4 + 4 + 4) == [1, 2, 4, 8]
    assert widths(Window(6), 100) == [1, 2, 4, 6]
    assert widths(Window(1), 100) == [1]


def test_replies_count_on_one_connection_only() -> None:
    window = Window(8)
    for _ in range(20):
        assert widths(window, 3) == [1]
        window.connected()


def test_trouble_holds_it_at_one_longer_and_longer() -> None:
    window = Window(8)
    now, held = 0.0, []
    for _ in range(9):
        window.trouble(now)
        began = now
        while widths(window, 12, now) == [1]:
            now += 1.0
        held.append(now - began)
    assert held[:3] == [FIRST_HOLD_S, 2 * FIRST_HOLD_S, 4 * FIRST_HOLD_S]
    assert held[-1] == LAST_HOLD_S


def test_an_hour_without_trouble_forgets_it() -> None:
    window = Window(8)
    for now in (0.0, 1.0, 2.0, 3.0):
        window.trouble(now)
    window.trouble(3.0 + FORGET_S)
    assert widths(window, 12, 3.0 + FORGET_S + FIRST_HOLD_S)[-1] == 8
