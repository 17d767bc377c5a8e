from __future__ import annotations

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.modbus.mbap import Adu, MbapSplitter, encode

ONE = encode(1, 11, b"\x03\x00\x00\x00\x01")
TWO = encode(0xFFFF, 255, b"\x01\x00\x00\x00\x10")
FOREIGN = ONE[:2] + b"\x00\x01" + ONE[4:]

adus = st.builds(Adu, st.integers(0, 0xFFFF), st.integers(0, 255), st.binary(min_size=1, max_size=253))


def header(length: int, protocol: int = 0) -> bytes:
    return b"\x00\x07" + protocol.to_bytes(2, "big") + length.to_bytes(2, "big")


def feed(*parts: bytes) -> tuple[list[Adu], str | None, int]:
    splitter = MbapSplitter()
    found: list[Adu] = []
    for part in parts:
        found += splitter.feed(part)
        assert splitter.pending < 260
    return found, splitter.lost, splitter.foreign


def test_one_adu() -> None:
    assert feed(ONE) == ([Adu(1, 11, b"\x03\x00\x00\x00\x01")], None, 0)


def test_several_in_one_segment_and_one_in_several() -> None:
    found, lost, _ = feed(ONE + TWO + ONE[:3], ONE[3:8], ONE[8:])
    assert [adu.tid for adu in found] == [1, 0xFFFF, 1]
    assert lost is None


@pytest.mark.parametrize("length", [0, 1, 255, 256, 65535])
@pytest.mark.parametrize("protocol", [0, 1])
def test_impossible_length_loses_the_framing_at_once(length: int, protocol: int) -> None:
    found, lost, _ = feed(ONE + header(length, protocol), ONE)
    assert found == [Adu(1, 11, b"\x03\x00\x00\x00\x01")]
    assert lost == "length"


@pytest.mark.parametrize("length", [2, 254])
def test_shortest_and_longest_adu(length: int) -> None:
    found, lost, _ = feed(header(length), b"\x0b" + bytes(length - 1))
    assert found == [Adu(7, 11, bytes(length - 1))]
    assert lost is None


def test_other_protocol_is_skipped_and_counted() -> None:
    assert feed(FOREIGN + ONE) == ([Adu(1, 11, b"\x03\x00\x00\x00\x01")], None, 1)


def test_three_of_another_protocol_in_a_row_lose_the_framing() -> None:
    assert feed(FOREIGN, FOREIGN, FOREIGN, ONE) == ([], "protocol", 3)


@pytest.mark.parametrize("between", [[ONE], [ONE[:4], ONE[4:]]], ids=["whole", "in parts"])
def test_the_row_is_broken_by_one_of_ours(between: list[bytes]) -> None:
    found, lost, foreign = feed(FOREIGN, FOREIGN, *between, FOREIGN, FOREIGN)
    assert (len(found), lost, foreign) == (1, None, 4)


@given(st.lists(adus, max_size=5), st.data())
def test_any_split_of_valid_adus(sent: list[Adu], data: st.DataObject) -> None:
    stream = b"".join(encode(*adu) for adu in sent)
    edges = sorted(data.draw(st.lists(st.integers(0, len(stream)), max_size=10)))
    parts = [stream[first:last] for first, last in pairwise([0, *edges, len(stream)])]
    assert feed(*parts) == feed(stream) == feed(*(bytes((byte,)) for byte in stream)) == (sent, None, 0)


@given(
    st.lists(
        st.one_of(
            adus.map(lambda adu: encode(*adu)),
            st.binary(max_size=20),
            st.builds(header, st.one_of(st.integers(0, 3), st.integers(253, 256)), st.integers(0, 1)),
            st.just(FOREIGN),
        ),
        max_size=8,
    ),
    st.data(),
)
def test_any_split_of_any_bytes_gives_the_same(pieces: list[bytes], data: st.DataObject) -> None:
    stream = b"".join(pieces)
    edges = sorted(data.draw(st.lists(st.integers(0, len(stream)), max_size=10)))
    parts = [stream[first:last] for first, last in pairwise([0, *edges, len(stream)])]
    assert feed(*parts) == feed(stream) == feed(*(bytes((byte,)) for byte in stream))
