"""Tests of the words for figures."""

import pytest

from vibrocast.codec.stream import CodingQuality
from vibrocast.host.cli.describe import describe_removed


@pytest.mark.parametrize(("part", "text"), [(1.0, "100 %"), (0.9996, "100 %"), (0.994, "99 %"), (0.00034, "0.034 %")])
def test_parts_of_the_energy_have_two_digits_and_no_exponent(part: float, text: str) -> None:
    quality = CodingQuality(snr_db=15.0, snr_db_per_channel=(15.0,), highpass_hz=20.0, removed_below=part)
    assert describe_removed(quality) == f"{text} of the energy below 20 Hz"
