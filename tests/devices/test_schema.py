from __future__ import annotations

from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.devices.forms import parse_map
from gateway.devices.model import Access, DeviceMap, Group, PollClass, Space, WordOrder
from gateway.devices.schema import load_map, models
from gateway.errors import MapError

Change = Callable[..., str]


def _problems(text: str) -> list[str]:
    with pytest.raises(MapError) as caught:
        parse_map(text, "small.toml")
    lines = str(caught.value).splitlines()
    assert all(line.startswith("small.toml: ") for line in lines)
    return [line.removeprefix("small.toml: ") for line in lines]


def test_a_right_map_becomes_the_model(small: DeviceMap) -> None:
    assert small.model == "small"
    assert small.functions == {1: Space.COILS, 3: Space.REGISTERS}
    energy = small.point("energy_total")
    assert (energy.words, energy.group, energy.access) == (2, Group.ENERGY, Access.READ)
    assert energy.reading().order is WordOrder.HI_LO
    assert energy.reading("swapped").order is WordOrder.LO_HI
    assert energy.metric_type == "counter"
    assert small.point("battery_voltage").metric_type == "gauge"
    limit = small.point("limit")
    assert (limit.minimum, limit.maximum, limit.plausible) == (0.0, 40.0, (-100.0, 100.0))
    assert small.extents[1].poll is PollClass.BACKGROUND
    assert small.log is not None
    assert [field.name for field in small.log.fields] == ["hourmeter", "voltage"]


def test_shipped_models_load() -> None:
    assert "prostar-mppt" in models()
    for model in models():
        assert load_map(model).model == model
        assert load_map(model) is load_map(model)


def test_an_unknown_model_is_named_with_the_known_ones() -> None:
    with pytest.raises(MapError, match=r"no map for model 'tristar'; known: .*prostar-mppt"):
        load_map("tristar")


def _load(point: str, disconnected: str, connected: str) -> tuple[str, str]:
    table = f'[load]\npoint = "{point}"\ndisconnected = {disconnected}\nconnected = {connected}\n\n[enumeration]'
    return "[enumeration]", table


@pytest.mark.parametrize(
    ("old", "new", "entry"),
    [
        ('symbol = "vb"', 'symbol = "vb"\ncolour = "red"', "point battery_voltage: colour: Extra"),
        ('symbol = "vb"', "", "point battery_voltage: symbol: Field required"),
        ("words = 2\nsymbol", "words = 9\nsymbol", "point energy_total: words"),
        ("address = 0x0004", 'address = "4"', "point charge_state: address"),
        ("address = 0x0004", "address = 0x10000", "point charge_state: address"),
        ("address = 0x0004", "address = true", "point charge_state: address"),
        ('name = "limit"', 'name = "Limit"', "point Limit: name"),
        ('name = "swapped"', 'name = "swa pped"', "point energy_total: alternative swa pped: name"),
        ("mib = { column = 3,", "mib = { column = 1,", "point charge_state: mib: column"),
        ('syntax = "Bits"', 'syntax = "Gauge32"', "point faults: mib: syntax"),
        ('poll = "live"\nwritable = true\ndoc = "RAM"', 'poll = "often"\ndoc = "RAM"', "extent ram: poll"),
        ('severity = "critical"', 'severity = "bad"', "bits: faults short: severity"),
        ('name = "on", text', 'name = "ON", text', "enumeration: state ON: name"),
        ('3 = "registers"', 'three = "registers"', "functions: three"),
        ('3 = "registers"', '3 = "words"', "functions: 3"),
        ('model = "small"', "", "model: Field required"),
        ("blocks = 16", "blocks = 0", "log: blocks"),
        ('name = "voltage"', 'name = "Voltage"', "log: field Voltage: name"),
    ],
)
def test_wrong_form_names_the_entry(changed: Change, old: str, new: str, entry: str) -> None:
    (problem,) = _problems(changed((old, new)))
    assert problem.startswith(entry)


@pytest.mark.parametrize(
    ("pieces", "problem"),
    [
        ([('order = "hi-lo"\n', "")], "point energy_total: reading document: a 32-bit point needs order"),
        ([('order = "lo-hi"\n', "")], "point energy_total: reading swapped: a 32-bit point needs order"),
        ([('symbol = "vb"', 'symbol = "vb"\norder = "hi-lo"')], "point battery_voltage: reading document: a single"),
        ([("address = 0x0004", "address = 0x0003")], "point charge_state: overlaps point energy_total at 0x0003"),
        ([("address = 0x0004", "address = 0x0009")], "point charge_state: 0x0009 lies in reserved hole"),
        ([("address = 0x0002", "address = 0x0007")], "point energy_total: 0x0007 lies in reserved hole"),
        ([("address = 0x0004", "address = 0x0010")], "point charge_state: 0x0010 is outside all extents"),
        ([("address = 0x0002", "address = 0x000F")], "point energy_total: 0x000F is outside all extents"),
        ([("address = 0x0004", "address = 0x8000")], "point charge_state: lies in extent log, which is never polled"),
        (
            [
                (
                    'last = 0x000F\npoll = "live"\nwritable = true\ndoc = "RAM"',
                    'last = 0x000F\npoll = "live"\ndoc = "RAM"',
                )
            ],
            "point limit: access write, but extent ram is read only",
        ),
        ([('codec = "enum"', 'codec = "float16"')], "point charge_state: reading document: unknown codec 'float16'"),
        ([('codec = "enum"', 'codec = "coil"')], "point charge_state: reading document: codec coil is for coils"),
        ([('codec = "enum"', 'codec = "u32"')], "point charge_state: reading document: codec u32 does not fit 1 word"),
        (
            [('codec = "u32"\norder = "hi-lo"', 'codec = "f16"\norder = "hi-lo"')],
            "point energy_total: reading document",
        ),
        ([('name = "swapped"', 'name = "document"')], "point energy_total: reading document: stands 2 times"),
        ([('order = "lo-hi"\nscale = 0.1', 'order = "lo-hi"\nscale = 0')], "point energy_total: reading swapped: s"),
        ([('enumeration = "state"', 'enumeration = "sate"')], "point charge_state: unknown enumeration 'sate'"),
        ([('enumeration = "state"\n', "")], "point charge_state: codec enum and enumeration None"),
        ([('bits = "faults"', 'bits = "fault"')], "point faults: unknown bit table 'fault'"),
        ([('bits = "faults"\n', "")], "point faults: codec bits and bit table None"),
        ([("number = 15", "number = 16")], "point faults: bit 16 of faults does not fit 1 word"),
        ([('unit = "A"', 'unit = "mA"')], "point limit: unknown unit 'mA'"),
        ([("maximum = 40", "maximum = -1")], "point limit: minimum is above maximum"),
        ([('access = "write"\n', "")], "point limit: minimum and maximum are for what can be written"),
        ([("plausible = [-100, 100]", "plausible = [100, -100]")], "point limit: plausible"),
        (
            [('bits = "faults"', 'bits = "faults"\nnamed_only = true')],
            "point faults: rewrite_s, restarts, named_only and wears are for what can be written",
        ),
        (
            [('help = "Limit."', 'help = "Limit."\nrestarts = true')],
            "point limit: what restarts the device is named_only",
        ),
        (
            [('help = "Limit."', 'help = "Limit."\nmultiplied_by = "times"')],
            "point limit: multiplied_by: no point times",
        ),
        ([('name = "limit"', 'name = "faults"')], "point faults: stands 2 times"),
        ([("number = 1, name", "number = 0, name")], "enumeration state: number 0: stands 2 times"),
        ([('name = "open"', 'name = "short"')], "bits faults: name short: stands 2 times"),
        (
            [('mib = { column = 3, syntax = "Enumeration" }', 'emc1 = { number = 45, form = "integer" }')],
            "emc1: points have a number and the table has no root",
        ),
        (
            [
                ("[identity]", '[emc1]\nroot = "1.3.6.1.4.1.33333.5"\n\n[identity]'),
                ('mib = { column = 3, syntax = "Enumeration" }', 'emc1 = { number = 45, form = "float" }'),
            ],
            "point charge_state: emc1: form float does not fit the point",
        ),
        *(
            (
                [
                    ("[identity]", '[emc1]\nroot = "1.3.6.1.4.1.33333.5"\n\n[identity]'),
                    (
                        'units = "millivolts", syntax = "Integer32" }',
                        f'units = "millivolts", syntax = "Integer32" }}\nemc1 = {{ number = 45, {form} }}',
                    ),
                ],
                f"point battery_voltage: emc1: form {wrong}",
            )
            for form, wrong in (
                ('form = "counts"', "counts does not fit the point"),
                ('form = "float", step = 2', "float has no step"),
                ('form = "word", step = 2', "word has no step"),
            )
        ),
        (
            [
                ("[identity]", '[emc1]\nroot = "1.3.6.1.4.1.33333.5"\n\n[identity]'),
                (
                    'mib = { column = 3, syntax = "Enumeration" }',
                    'emc1 = { number = 45, form = "counts", step = 1 }',
                ),
            ],
            "point charge_state: emc1: form counts does not fit the point",
        ),
        (
            [
                (
                    'units = "millivolts", syntax = "Integer32" }',
                    'units = "millivolts", syntax = "Integer32" }\nemc1 = { number = 45, form = "float" }',
                ),
                ('mib = { column = 3, syntax = "Enumeration" }', 'emc1 = { number = 45, form = "integer" }'),
            ],
            "emc1: number 45: stands 2 times",
        ),
        ([("mib = { column = 4", "mib = { column = 3")], "point faults: mib: column 3 of table live belongs to"),
        ([('units = "millivolts"', 'units = "volts"')], "point battery_voltage: mib: scale 1000 'volts'"),
        ([("{ column = 2, scale = 1000", "{ column = 2, scale = 100")], "point battery_voltage: mib: scale 100"),
        (
            [('column = 3, syntax = "Enumeration"', 'column = 3, syntax = "Integer32"')],
            "point charge_state: mib: syntax",
        ),
        (
            [("morningstar_battery_voltage_volts", "morningstar_battery_volts")],
            "point battery_voltage: metric morningstar_",
        ),
        ([("morningstar_battery_voltage_volts", "battery_voltage_volts")], "point battery_voltage: metric battery_"),
        ([("energy_watthours_total", "energy_total_watthours")], "point energy_total: metric morningstar_energy_total"),
        ([("metric_scale = 1000", "metric_scale = 1")], "point energy_total: metric_scale: must be 1000"),
        ([("morningstar_faults", "morningstar_charge_state")], "metric morningstar_charge_state: stands 2 times"),
        ([('1 = "coils"\n', "")], "functions: none reads coils"),
        ([('3 = "registers"', '3 = "registers"\n5 = "registers"')], "functions: 5: is no such function for registers"),
        ([("last = 0x0009", "last = 0x0007")], "reserved hole: last 0x0007 is before first 0x0008"),
        ([("last = 0x0009", "last = 0x0010")], "reserved hole: 0x0008..0x0010 is outside all extents"),
        ([("first = 0x8000\nlast", "first = 0x000F\nlast")], "extent log: overlaps ram at 0x000F"),
        ([('name = "log"', 'name = "ram"')], "extent ram: stands 2 times"),
        ([("blocks = 16\n", "blocks = 17\n")], "log: 0x8000..0x810F needs an extent of poll class background"),
        ([("offset = 2", "offset = 1")], "log: field voltage: overlaps field hourmeter at offset 1"),
        ([("offset = 2", "offset = 16")], "log: field voltage: ends after the block"),
        (
            [('offset = 2\ncodec = "f16"', 'offset = 2\ncodec = "u32"')],
            "log: field voltage: codec u32 does not fit 1 word",
        ),
        ([('offset = 2\ncodec = "f16"', 'offset = 2\ncodec = "coil"')], "log: field voltage: codec coil does not fit"),
        (
            [('codec = "f16"\nunit = "V"\nhelp = "Voltage."', 'codec = "f16"\nunit = "mV"\nhelp = "V."')],
            "log: field voltage: unknown unit 'mV'",
        ),
        (
            [('help = "Voltage."', 'help = "Voltage."\nbits = "alarms"')],
            "log: field voltage: unknown bit table 'alarms'",
        ),
        ([('name = "hourmeter"', 'name = "hours"')], "log: needs a field hourmeter of 2 words"),
        (
            [('help = "Reset."', 'help = "Reset."\nmib = { column = 2, syntax = "Unsigned32" }')],
            "point reset: mib: group command has no table",
        ),
        ([('offset = 2\ncodec = "f16"', 'offset = 2\ncodec = "f17"')], "log: field voltage: unknown codec 'f17'"),
        (
            [
                ('access = "set"', 'access = "write"'),
                ('group = "command"', 'group = "live"\nmetric = "morningstar_res"'),
            ],
            "point reset: metric morningstar_res: must be morningstar_reset",
        ),
        (
            [
                ('group = "settings"', 'group = "settings"\nmetric = "morningstar_limit_amperes"'),
                ('name = "limit"', 'name = "limit_amperes"'),
            ],
            "point limit_amperes: the name repeats the unit",
        ),
        ([('access = "set"', 'access = "set"\nmetric = "morningstar_reset"')], "point reset: metric: group command"),
        (
            [('group = "live"\ncodec = "bits"', 'group = "live"\naccess = "set"\ncodec = "bits"')],
            "point faults: set only",
        ),
        ([('conditions = { first = 100, name = "fault" }\n', "")], "point faults: conditions: live bits need them"),
        ([("first = 100, name", "first = 150, name")], "point faults: conditions: first 150; allowed: 100, 200, 300"),
        (
            [('enumeration = "state"', 'enumeration = "state"\nconditions = { first = 200, name = "state" }')],
            "point charge_state: conditions: are for live bits",
        ),
        (
            [('enumeration = "state"', 'enumeration = "state"\nconditions = { first = 100, name = "fault" }')],
            "point faults: conditions: first 100 belongs to charge_state",
        ),
        (
            [('enumeration = "state"', 'enumeration = "state"\nconditions = { first = 200, name = "fault" }')],
            "point faults: conditions: name fault belongs to charge_state",
        ),
        ([_load("limit", "[0]", "[1]")], "load: no polled enumeration limit"),
        ([_load("charge_state", "[7]", "[1]")], "load: 7 is no value of charge_state"),
        ([_load("charge_state", "[0, 1]", "[1]")], "load: 1 is both connected and disconnected"),
    ],
)
def test_nonsense_names_the_entry(changed: Change, pieces: list[tuple[str, str]], problem: str) -> None:
    problems = _problems(changed(*pieces))
    assert [found for found in problems if found.startswith(problem)], problems


def test_all_problems_come_at_once(changed: Change) -> None:
    problems = _problems(
        changed(("address = 0x0004", "address = 0x0003"), ('unit = "A"', 'unit = "mA"'), ("offset = 2", "offset = 1"))
    )
    assert len(problems) == 3


def test_all_wrong_forms_come_at_once(changed: Change) -> None:
    problems = _problems(changed(('symbol = "vb"', ""), ("blocks = 16", "blocks = 0"), ('model = "small"', "")))
    assert len(problems) == 3


def test_text_that_is_not_toml_is_named() -> None:
    assert _problems("model = ")[0].startswith("not TOML")


@given(data=st.data())
def test_a_damaged_map_is_loaded_or_refused(small_text: str, data: st.DataObject) -> None:
    lines = small_text.splitlines()
    at = data.draw(st.integers(0, len(lines) - 1))
    lines[at] = data.draw(st.sampled_from(["", "x = 1", lines[at - 1], "[[point]]", "name = 3", "[log]", 'mib = "x"']))
    try:
        assert parse_map("\n".join(lines), "small.toml").title
    except MapError as error:
        assert "small.toml: " in str(error)  # noqa: PT017 - both outcomes are right
