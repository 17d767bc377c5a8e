from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.devices.model import TEXT_CODEC_NAMES, WordOrder
from gateway.devices.texts import MAX_WORDS, TEXT_CODECS, decode_text, encode_text, swapped, words_of

HI, LO = WordOrder.HI_LO, WordOrder.LO_HI


def test_the_model_knows_which_codecs_give_text() -> None:
    assert TEXT_CODECS.keys() == TEXT_CODEC_NAMES


@pytest.mark.parametrize(
    ("data", "expected"),
    [
        (b"12345678", "12345678"),
        (b"1234\0\0\0\0", "1234"),
        (b"1234\x00678", "1234"),
        (b"12345   ", "12345"),
        (b"12 45678", "12 45678"),
        (b"\xff" * 8, None),
        (b"\0" * 8, None),
        (b"\0abcdefg", None),
        (b"12\x0145678", None),
        (b"1234567\xe9", None),
    ],
)
def test_ascii_ends_at_a_nul_and_is_printable_or_nothing(data: bytes, expected: str | None) -> None:
    assert decode_text("ascii", data, HI) == expected


def test_the_documents_serial_number_has_the_first_character_in_the_low_byte() -> None:
    words = (0x3130, 0x3332, 0x3534, 0x3736)
    data = b"".join(word.to_bytes(2, "big") for word in words)
    assert decode_text("ascii", data, LO) == "01234567"
    assert decode_text("ascii", data, HI) == "10325476"
    assert encode_text("ascii", "01234567", 4, LO) == words


def test_the_documents_hardware_version_is_two_bytes() -> None:
    assert decode_text("version", b"\x01\x02", HI) == "1.2"
    assert decode_text("version", b"\x02\x0c", HI) == "2.12", "binary, not characters and not decimal digits"
    assert decode_text("version", b"\xff\xff", HI) is None


def test_an_address_is_in_the_order_of_its_bytes() -> None:
    """IPAddrByte[1][0] is the first register: byte 0 in its low half."""
    assert decode_text("ipv4", bytes.fromhex("a8c0fd01"), LO) == "192.168.1.253"
    assert decode_text("ipv4", bytes.fromhex("c0a801fd"), HI) == "192.168.1.253"
    assert decode_text("ipv4", bytes(4), LO) == "0.0.0.0"
    assert encode_text("ipv4", "192.168.1.253", 2, LO) == (0xA8C0, 0xFD01)


def test_a_mac_address_is_six_bytes_with_colons() -> None:
    assert decode_text("mac", bytes.fromhex("1e00010cfeca"), LO) == "00:1e:0c:01:ca:fe"
    assert decode_text("mac", bytes(6), LO) is None
    assert decode_text("mac", b"\xff" * 6, LO) is None
    assert encode_text("mac", "00:1e:0c:01:ca:fe", 3, LO) == (0x1E00, 0x010C, 0xFECA)


@pytest.mark.parametrize(
    ("codec", "text", "words"),
    [
        ("ascii", "", 4),
        ("ascii", "123456789", 4),
        ("ascii", "Hütte", 4),
        ("ascii", " 1", 4),
        ("ascii", "1\0", 4),
        ("ipv4", "192.168.1", 2),
        ("ipv4", "192.168.1.256", 2),
        ("mac", "00:1e:0c:01:ca", 3),
        ("mac", "00-1e-0c-01-ca-fe", 3),
        ("mac", "00:00:00:00:00:00", 3),
        ("version", "1", 1),
        ("version", "1.256", 1),
        ("version", "255.255", 1),
        ("version", "-1.2", 1),
    ],
)
def test_what_cannot_be_said_is_refused(codec: str, text: str, words: int) -> None:
    with pytest.raises(ValueError, match=r".+"):
        encode_text(codec, text, words, HI)


@pytest.mark.parametrize(("codec", "words"), [(name, n) for name, codec in TEXT_CODECS.items() for n in codec.words])
@given(data=st.data())
def test_any_bytes_are_nothing_or_a_text_that_can_be_written_back(codec: str, words: int, data: st.DataObject) -> None:
    raw = data.draw(st.binary(min_size=2 * words, max_size=2 * words))
    order = data.draw(st.sampled_from(WordOrder))
    text = decode_text(codec, raw, order)
    if text is not None:
        assert text
        assert text.isprintable()
        again = b"".join(word.to_bytes(2, "big") for word in encode_text(codec, text, words, order))
        assert decode_text(codec, again, order) == text


@given(st.binary(max_size=2 * MAX_WORDS).filter(lambda data: len(data) % 2 == 0))
def test_swapping_twice_changes_nothing(data: bytes) -> None:
    assert swapped(swapped(data, LO), LO) == data == swapped(data, HI)
    assert b"".join(word.to_bytes(2, "big") for word in words_of(data)) == data
