"""What lasts is not looked at again; what a reload leaves behind goes."""

from __future__ import annotations

import gc
import weakref
from collections.abc import Iterator

import pytest

from gateway.service.garbage import set_aside


class Ring:
    """An object that only a collection can free."""

    def __init__(self) -> None:
        self.itself = self


@pytest.fixture(autouse=True)
def unfrozen() -> Iterator[None]:
    yield
    gc.unfreeze()


def test_what_lasts_is_set_aside_and_what_comes_later_is_not() -> None:
    lasting = Ring()
    set_aside()
    assert gc.get_freeze_count() > 10_000
    later = weakref.ref(Ring())
    gc.collect()
    assert later() is None
    assert lasting.itself is lasting


def test_what_was_set_aside_goes_with_the_next_time() -> None:
    old = Ring()
    set_aside()
    gone = weakref.ref(old)
    del old
    gc.collect()
    assert gone() is not None
    set_aside()
    assert gone() is None
