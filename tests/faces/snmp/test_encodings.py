"""Numbers of points on the wire: what pysnmp writes of them, found by the number alone."""

from __future__ import annotations

import math

import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from pyasn1.codec.ber import encoder
from pysnmp.proto import rfc1902

from gateway.devices.model import Value
from gateway.faces.snmp import encodings
from gateway.faces.snmp.encodings import Encodings, of_bits, of_numbers
from gateway.faces.snmp.objects import Syntax

NUMBERS = st.one_of(st.integers(-(2**33), 2**33), st.floats(width=16), st.floats(-1e7, 1e7))


@given(st.sampled_from([(Syntax.INTEGER32, 1), (Syntax.INTEGER32, 1000), (Syntax.UNSIGNED32, 10)]), NUMBERS)
@example((Syntax.INTEGER32, 1000), 2147483.647)
@example((Syntax.INTEGER32, 1000), 2147483.648)
@example((Syntax.UNSIGNED32, 10), -0.04)
@example((Syntax.UNSIGNED32, 10), -0.06)
@example((Syntax.INTEGER32, 1), -0.0)
def test_a_number_is_written_as_pysnmp_writes_it_or_is_not_there(of: tuple[Syntax, int], value: Value) -> None:
    syntax, scale = of
    least, most = (-(2**31), 2**31 - 1) if syntax is Syntax.INTEGER32 else (0, 2**32 - 1)
    known = of_numbers(syntax, scale)
    scaled = value * scale
    if not math.isfinite(scaled) or not least <= round(scaled) <= most:
        with pytest.raises(KeyError):
            known[value]
        return
    kind = rfc1902.Integer32 if syntax is Syntax.INTEGER32 else rfc1902.Unsigned32
    assert known[value] == encoder.encode(kind(round(scaled)))
    assert known[value] is known[value]


@given(NUMBERS)
def test_equal_numbers_are_written_the_same_whichever_came_first(value: Value) -> None:
    if not math.isfinite(value) or abs(value) > 2**31 - 1 or value != int(value):
        return
    for first, second in ((int(value), float(value)), (float(value), int(value))):
        fresh = Encodings(of_numbers(Syntax.INTEGER32, 1).cell, Syntax.INTEGER32)
        assert fresh[first] == fresh[second] == Encodings(fresh.cell, Syntax.INTEGER32)[second]


@given(st.sampled_from([1, 2]), st.integers(-1, 2**33))
@example(1, 2**16)
@example(1, 2**16 - 1)
def test_bits_begin_with_bit_0(words: int, value: int) -> None:
    known = of_bits(words)
    if not 0 <= value < 1 << 16 * words:
        with pytest.raises(KeyError):
            known[value]
        return
    octets = encoder.encode(rfc1902.OctetString(known.cell(value)))
    assert known[value] == octets
    named = [bit for bit in range(16 * words) if octets[2 + bit // 8] & 0x80 >> bit % 8]
    assert sum(1 << bit for bit in named) == value


def test_few_are_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(encodings, "MOST_KEPT", 10)
    known = Encodings(of_numbers(Syntax.INTEGER32, 1).cell, Syntax.INTEGER32)
    for value in (*range(100), *range(100)):
        assert known[value] == encoder.encode(rfc1902.Integer32(value))
        assert len(known) <= 10
