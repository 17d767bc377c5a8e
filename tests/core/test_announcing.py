"""What a receiver is told: in turns, not too often, and what holds."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.core.announcing import Announcement, Announcer
from gateway.core.conditions import Conditions, ConditionState, Severity
from gateway.core.site import Device, Site
from gateway.core.snapshot import DeviceState
from tests.core.test_conditions import MAP, FakeLine, Plant


class Story:
    """One device and one receiver of announcements about it."""

    def __init__(self, hold_s: float = 30.0, least: Severity = Severity.INFO) -> None:
        self.plant = Plant()
        self.announcer = Announcer(hold_s=hold_s, least=least)
        self.plant.shows()
        self.hear()

    def hear(self) -> None:
        self.announcer.changed(self.plant.conditions.take(), self.plant.now)

    def shows(self, **values: int) -> None:
        self.plant.shows(**values)
        self.hear()

    def take(self, room: int = 100, *, confirm: bool = True) -> list[str]:
        found = self.announcer.take(self.plant.now, room)
        if confirm:
            for each in found:
                self.announcer.confirmed(each.watch)
        return [text(each) for each in found]


def text(announcement: Announcement) -> str:
    state = "raised" if announcement.raised else "clear"
    return f"{announcement.watch.condition.code} {state}{' summary' if announcement.summary else ''}"


def test_a_fault_is_told_when_it_comes_and_when_it_goes() -> None:
    story = Story()
    assert story.take() == []
    story.shows(array_faults=1)
    assert story.announcer.next_due() == story.plant.now
    assert story.take() == ["100 raised"]
    assert story.take() == []
    story.plant.wait(60)
    story.shows()
    assert story.take() == ["100 clear"]
    assert (story.announcer.next_due(), len(story.announcer)) == (None, 0)


def test_what_changes_soon_after_is_told_later() -> None:
    story = Story(hold_s=30.0)
    story.shows(array_faults=1)
    story.take()
    told_at = story.plant.now
    story.shows()
    assert story.take() == []
    assert story.announcer.next_due() == told_at + 30
    story.plant.wait(30)
    assert story.take() == ["100 clear"]


def test_what_flaps_is_told_at_most_once_a_hold_and_in_turns() -> None:
    story = Story(hold_s=30.0)
    told = []
    for second in range(3600):
        story.shows(array_faults=second % 2)
        told += story.take()
    assert 100 <= len(told) <= 3600 / 30 + 1
    assert told == ["100 raised", "100 clear"] * (len(told) // 2) + ["100 raised"] * (len(told) % 2)


def test_what_was_over_before_it_could_be_told_is_told_as_both() -> None:
    story = Story(hold_s=30.0)
    story.shows(array_faults=1)
    story.take()
    story.plant.wait(60)
    story.shows()
    story.take()
    story.shows(array_faults=1)
    story.shows()
    story.plant.wait(30)
    assert story.take() == ["100 raised"]
    story.plant.wait(30)
    assert story.take() == ["100 clear"]


def test_a_device_that_is_away_changes_nothing_for_its_faults() -> None:
    story = Story(hold_s=0.0)
    story.shows(array_faults=1)
    assert story.take() == ["100 raised"]
    story.plant.becomes(state=DeviceState.OFFLINE)
    story.hear()
    assert story.take() == ["401 raised"]
    story.shows(array_faults=1)
    assert story.take() == ["401 clear"]
    story.plant.becomes(state=DeviceState.OFFLINE)
    story.shows()
    assert sorted(story.take()) == ["100 clear", "401 raised"]


def test_what_holds_already_is_a_summary() -> None:
    story = Story(hold_s=0.0)
    story.plant = Plant()
    story.shows(array_faults=0b1)
    assert story.take() == ["100 raised summary"]
    story.shows()
    assert story.take() == ["100 clear"]
    story.shows(array_faults=0b1)
    assert story.take() == ["100 raised"]


def test_what_is_less_severe_is_not_told() -> None:
    story = Story(least=Severity.WARNING)
    story.shows(alarms=1 << 23 | 1 << 17 | 1)
    assert story.take() == ["300 raised", "317 raised"]


def test_there_is_room_for_so_many() -> None:
    story = Story()
    story.shows(array_faults=0xFFF)
    assert len(story.take(5)) == 5
    assert len(story.take()) == 7


def reloaded(story: Story, *names: str) -> None:
    """A reload: a device of that name is unit 7 on a line of its own, or none is."""
    plant = story.plant
    plant.line, devices = FakeLine(), []
    for name in names:
        plant.device = Device(name, 7, 1, MAP)
        plant.device.line = plant.line
        devices.append(plant.device)
    plant.conditions = Conditions(Site.of("s", (plant.line,), devices), (), plant.now, plant.conditions)
    story.announcer.go_on(plant.conditions)
    story.hear()


def test_what_was_told_before_a_reload_is_told_as_clear_when_it_is() -> None:
    """Somebody mends the cable, writes another device into the file, and reloads: the line and its devices are new."""
    for name in ("d", "another"):
        story = Story()
        story.shows(array_faults=1)
        assert story.take() == ["100 raised"]
        reloaded(story, name)
        story.plant.wait(60)
        assert story.take() == []
        story.shows()
        assert story.take() == ["100 clear"]
        story.plant.wait(60)
        story.shows(array_faults=1)
        assert story.take() == ["100 raised"]


def test_what_is_raised_after_a_reload_too_is_not_told_again() -> None:
    story = Story()
    for fault in (1, 0, 1):
        story.plant.wait(60)
        story.shows(array_faults=fault)
        story.take()
    reloaded(story, "d")
    story.plant.wait(60)
    story.shows(array_faults=1)
    assert story.take() == []
    story.plant.wait(60)
    story.shows()
    assert story.take() == ["100 clear"]
    story.plant.wait(60)
    story.shows(array_faults=1)
    assert story.take() == ["100 raised"]


def test_what_waits_of_a_device_that_goes_is_not_told() -> None:
    for names in (("another",), ()):
        story = Story()
        story.shows(array_faults=1)
        under_way = story.announcer.take(story.plant.now, 1)
        story.shows(array_faults=3)
        reloaded(story, *names)
        assert story.take() == []
        assert len(story.announcer) == 0
        story.announcer.confirmed(under_way[0].watch)
        assert story.take() == []
        reloaded(story, "d")
        story.plant.wait(60)
        story.shows(array_faults=2)
        assert story.take() == [*(["100 clear"] if names else []), "101 raised summary"]


def test_a_trap_that_was_lost_during_a_reload_is_told_again_only_of_what_holds() -> None:
    for names in (("d",), ()):
        story = Story()
        story.shows(array_faults=1)
        under_way = story.announcer.take(story.plant.now, 1)
        reloaded(story, *names)
        story.announcer.lost(under_way[0])
        assert story.take() == []


def test_nothing_more_is_told_before_it_is_confirmed() -> None:
    story = Story(hold_s=0.0)
    story.shows(array_faults=1)
    assert story.take(confirm=False) == ["100 raised"]
    story.shows()
    assert story.take() == []
    assert story.announcer.next_due() is None
    story.announcer.confirmed(story.plant.watch(100))
    assert story.take() == ["100 clear"]


@pytest.mark.parametrize("first", ["raise", "clear"])
def test_what_was_lost_is_told_again(first: str) -> None:
    story = Story(hold_s=30.0)
    story.shows(array_faults=1)
    if first == "clear":
        story.take()
        story.plant.wait(60)
        story.shows()
    [lost] = story.announcer.take(story.plant.now, 1)
    story.announcer.lost(lost)
    assert story.take() == [text(lost)]


class Link:
    """A receiver behind a bad link: what it was told, and what is on the way to it."""

    def __init__(self) -> None:
        self.story = Story(hold_s=30.0)
        self.heard: dict[int, list[bool]] = {}
        self.under_way: list[Announcement] = []

    def shows(self, bits: int) -> None:
        self.story.shows(array_faults=bits)

    def away(self, _: int) -> None:
        self.story.plant.becomes(state=DeviceState.OFFLINE)
        self.story.hear()

    def wait(self, seconds: int) -> None:
        self.story.plant.wait(seconds)
        self.story.hear()

    def take(self, room: int) -> None:
        self.under_way += self.story.announcer.take(self.story.plant.now, room)

    def confirm(self, _: int = 0) -> None:
        while self.under_way:
            each = self.under_way.pop()
            self.heard.setdefault(each.watch.condition.code, []).append(each.raised)
            self.story.announcer.confirmed(each.watch)

    def lose(self, _: int) -> None:
        while self.under_way:
            self.story.announcer.lost(self.under_way.pop())


STEPS = {"shows": 3, "away": 0, "wait": 60, "take": 2, "confirm": 0, "lose": 0}


@given(
    st.lists(
        st.sampled_from(sorted(STEPS)).flatmap(lambda step: st.tuples(st.just(step), st.integers(0, STEPS[step]))),
        max_size=60,
    )
)
def test_every_receiver_knows_in_the_end_what_holds_and_was_told_in_turns(steps: list[tuple[str, int]]) -> None:
    link = Link()
    for step, number in steps:
        getattr(link, step)(number)
    for _ in range(4):
        link.confirm()
        link.wait(30)
        link.take(100)
    link.confirm()
    for watch in link.story.plant.conditions:
        told = link.heard.get(watch.condition.code, [])
        assert told == [n % 2 == 0 for n in range(len(told))]
        assert (len(told) % 2 == 1) == (watch.known is ConditionState.RAISED), watch
    assert link.story.announcer.next_due() is None
