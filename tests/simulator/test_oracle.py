"""The oracle: every word names its device, address and read."""

from __future__ import annotations

import pytest

from gateway.devices.decode import Decoder
from gateway.devices.model import DeviceMap, Space
from gateway.devices.schema import load_map
from gateway.modbus.pdu import parse_identification, read_identification_request
from gateway.simulator.oracle import REMEMBERED, OracleController, Verdict


def test_all_registers_of_three_devices_differ(oracles: tuple[OracleController, ...]) -> None:
    words = [unit.word(address) for unit in oracles for address in unit.addresses]
    assert len(words) == 3 * (82 + 4096 + 80)
    assert len(set(words)) == len(words)


def test_reads_give_the_words_of_the_address(oracles: tuple[OracleController, ...]) -> None:
    for unit in oracles:
        assert unit.read(Space.REGISTERS, 0xE000, 80, 0.0) == [unit.word(0xE000 + k) for k in range(80)]
        assert unit.read(Space.COILS, 0, 256, 0.0) == [unit.coil(k) for k in range(256)]


def test_coils_of_the_devices_differ(oracles: tuple[OracleController, ...]) -> None:
    coils = {tuple(unit.coil(address) for address in unit.coil_addresses) for unit in oracles}
    assert len(coils) == 3
    assert all(50 < sum(listed) < 206 for listed in coils)


def test_the_ranges_are_the_maps(oracles: tuple[OracleController, ...]) -> None:
    unit = oracles[0]
    assert unit.handle(bytes([3, 0, 0x51, 0, 2]), 0.0) == bytes([0x83, 2])
    assert unit.handle(bytes([1, 1, 0, 0, 1]), 0.0) == bytes([0x81, 2])
    assert unit.handle(bytes([6, 0, 0x52, 0, 1]), 0.0) == bytes([0x86, 2])


def test_a_sequenced_reply_names_its_read(prostar_map: DeviceMap) -> None:
    unit = OracleController(prostar_map, sequenced=True)
    replies = [unit.read(Space.REGISTERS, 0x10, 20, 0.0) for _ in range(50)]
    assert len({tuple(words) for words in replies}) == 50
    assert [unit.sequence_of(0x10, words) for words in replies] == list(range(1, 51))
    assert unit.sequence_of(0x10, replies[0], oldest=2) is None


def test_torn_foreign_and_shifted_replies_have_no_read(prostar_map: DeviceMap) -> None:
    unit, other = (OracleController(prostar_map, device=k, sequenced=True) for k in range(2))
    earlier, later = (unit.read(Space.REGISTERS, 0x10, 20, 0.0) for _ in range(2))
    foreign = other.read(Space.REGISTERS, 0x10, 20, 0.0)
    assert unit.sequence_of(0x10, earlier[:10] + later[10:]) is None
    assert unit.sequence_of(0x10, foreign) is None
    assert unit.sequence_of(0x11, later) is None


def test_writes_are_confirmed_noted_and_forgotten(prostar_map: DeviceMap) -> None:
    unit = OracleController(prostar_map)
    request = bytes([6, 0xE0, 0x00, 0x12, 0x34])
    assert unit.handle(request, 0.0) == request
    assert unit.writes == [(Space.REGISTERS, 0xE000, 0x1234)]
    assert unit.read(Space.REGISTERS, 0xE000, 1, 0.0) == [unit.word(0xE000)]


def test_there_is_room_for_fifteen_devices(prostar_map: DeviceMap) -> None:
    OracleController(prostar_map, device=14)
    with pytest.raises(ValueError, match="no room for device 15"):
        OracleController(prostar_map, device=15)


def test_the_revision_names_the_device(oracles: tuple[OracleController, ...]) -> None:
    replies = [parse_identification(unit.handle(read_identification_request(), 0.0) or b"") for unit in oracles]
    assert [reply.objects[2] for reply in replies] == [b"v01.00.00", b"v01.00.01", b"v01.00.02"]


def sampled(unit: OracleController, space: Space, first: int, count: int, at: float) -> bytes:
    """The payload of a read."""
    cells = unit.read(space, first, count, at)
    if space is Space.COILS:
        packed = sum(cell << k for k, cell in enumerate(cells))
        return packed.to_bytes((count + 7) // 8, "little")
    return b"".join(cell.to_bytes(2, "big") for cell in cells)


@pytest.fixture
def pair(prostar_map: DeviceMap) -> tuple[OracleController, OracleController]:
    unit, other = (OracleController(prostar_map, device=k, sequenced=True) for k in range(2))
    for k in range(40):
        for one in (unit, other):
            sampled(one, Space.REGISTERS, 0, 82, 100.0 + k)
            sampled(one, Space.COILS, 0, 256, 100.5 + k)
    return unit, other


@pytest.mark.parametrize(("space", "first", "count"), [(Space.REGISTERS, 0x10, 6), (Space.COILS, 0x10, 64)])
def test_the_verdicts_of_the_oracle(
    pair: tuple[OracleController, OracleController], space: Space, first: int, count: int
) -> None:
    unit, other = pair
    old = sampled(unit, space, first, count, 200.0)
    new = sampled(unit, space, first, count, 201.0)
    foreign = sampled(other, space, first, count, 201.0)
    half = len(old) // 2

    def verdict(data: bytes, asked_at: float = 200.5, at: int = first, max_age_s: float | None = None) -> Verdict:
        return unit.judge(space, at, count, data, asked_at=asked_at, max_age_s=max_age_s)

    assert verdict(new) is Verdict.RIGHT
    assert verdict(old) is Verdict.LATE
    assert verdict(old, max_age_s=1.0) is Verdict.RIGHT
    assert verdict(old, max_age_s=0.2) is Verdict.STALE
    assert verdict(foreign) is Verdict.FOREIGN
    assert verdict(new, at=first + 1) is Verdict.FOREIGN
    assert verdict(new[:-1]) is Verdict.FOREIGN
    assert verdict(old[:half] + new[half:]) is (Verdict.TORN if space is Space.REGISTERS else Verdict.FOREIGN)


def test_replies_and_exceptions_are_judged_by_their_request(pair: tuple[OracleController, OracleController]) -> None:
    unit, other = pair
    for request in (b"\x03\x00\x10\x00\x04", b"\x04\x00\x10\x00\x01", b"\x01\x00\x00\x00\x20", b"\x2b\x0e\x01\x00"):
        reply, foreign = unit.handle(request, 300.0), other.handle(request, 300.0)
        assert reply is not None
        assert foreign is not None
        assert unit.judge_reply(request, reply, asked_at=300.0) is Verdict.RIGHT
        assert unit.judge_reply(request, foreign, asked_at=300.0) is Verdict.FOREIGN
        assert unit.judge_reply(request, bytes([request[0] | 0x80, 2]), asked_at=300.0) is Verdict.FOREIGN
    assert unit.judge_reply(b"\x03\x00\x51\x00\x02", b"\x83\x02", asked_at=300.0) is Verdict.RIGHT
    assert unit.judge_reply(b"\x03\x00\x51\x00\x02", b"\x03\x04\0\0\0\0", asked_at=300.0) is Verdict.FOREIGN


def test_decoded_values_are_judged_too(pair: tuple[OracleController, OracleController]) -> None:
    unit, other = pair
    decoder = Decoder(unit.map)
    points = {point.name: point for point in unit.map.points}
    old = decoder.decode(Space.REGISTERS, 0, sampled(unit, Space.REGISTERS, 0, 82, 400.0))
    new = decoder.decode(Space.REGISTERS, 0, sampled(unit, Space.REGISTERS, 0, 82, 401.0))
    foreign = decoder.decode(Space.REGISTERS, 0, sampled(other, Space.REGISTERS, 0, 82, 401.0))
    assert len(new) > 10
    assert {unit.judge_value(points[name], value, read_at=401.0) for name, value in new.items()} == {Verdict.RIGHT}
    late = [unit.judge_value(points[name], value, read_at=401.0) for name, value in old.items()]
    assert late.count(Verdict.LATE) > 0.9 * len(late)  # a code with few values may be the same in both
    strangers = [unit.judge_value(points[name], value, read_at=401.0) for name, value in foreign.items()]
    assert strangers.count(Verdict.FOREIGN) > 0.9 * len(strangers)


def test_only_so_many_answers_are_remembered(prostar_map: DeviceMap) -> None:
    unit = OracleController(prostar_map, sequenced=True)
    first = sampled(unit, Space.REGISTERS, 0, 2, 0.0)
    for k in range(REMEMBERED):
        sampled(unit, Space.REGISTERS, 0, 2, float(k))
    assert unit.judge(Space.REGISTERS, 0, 2, first, asked_at=0.0) is Verdict.FOREIGN
    assert len(unit._numbered) == REMEMBERED


def test_a_value_that_the_unit_scales_is_judged_by_the_scaling_in_the_same_answer() -> None:
    unit = OracleController(load_map("tristar-mppt"), sequenced=True)
    point = unit.map.point("battery_voltage")
    words = unit.read(Space.REGISTERS, 0, 92, 500.0)
    value = (words[0x19] - (words[0x19] >> 15 << 16)) / 32768 * (words[0] + words[1] / 65536)
    assert unit.judge_value(point, value, read_at=500.0) is Verdict.RIGHT
    assert unit.judge_value(point, value, read_at=501.0) is Verdict.LATE
    assert unit.judge_value(point, value + 1, read_at=500.0) is Verdict.FOREIGN
