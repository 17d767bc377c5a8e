"""The oracle: every word names its device, address and read."""

from __future__ import annotations

import pytest

from gateway.devices.model import DeviceMap, Space
from gateway.modbus.pdu import parse_identification, read_identification_request
from gateway.simulator.oracle import OracleController


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
