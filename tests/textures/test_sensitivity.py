"""Sensitivities as data sheets state them."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vibrocast.errors import InputError
from vibrocast.textures.sensitivity import Sensitivity, parse


@pytest.mark.parametrize(
    ("text", "per_unit", "unit", "in_volts"),
    [
        ("10.2mV/g", 10.2e-3 / 9.80665, "m/s^2", True),
        ("1mV/(m/s^2)", 1e-3, "m/s^2", True),
        ("0.3mV/um", 0.3e-3, "um", True),
        (".5uV/nm", 0.5e-3, "um", True),
        ("256/g", 256 / 9.80665, "m/s^2", False),
        ("1/(m/s^2)", 1.0, "m/s^2", False),
    ],
)
def test_a_sensitivity_is_per_unit(text: str, per_unit: float, unit: str, in_volts: bool) -> None:
    assert parse(text) == Sensitivity(pytest.approx(per_unit), unit, in_volts, text)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "text", ["", "10.2", "mV/g", "-1mV/g", "0mV/g", "1e999mV/g", "1mV/parsec", "1kV/g", "1mV/drive", "1mV/(g", "nan/g"]
)
def test_anything_else_is_rejected(text: str) -> None:
    with pytest.raises(InputError):
        parse(text)


@given(st.text(max_size=30))
def test_any_text_is_a_sensitivity_or_rejected(text: str) -> None:
    try:
        assert parse(text).per_unit > 0
    except InputError:
        return
