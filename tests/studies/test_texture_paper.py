"""The texture paper's figures, repeated: exact percentages, and what coding measures."""

import numpy as np
import pytest

from studies import texture_paper
from studies.texture_paper import Result, code, measure, paper_percent
from vibrocast import codec, textures


def test_arithmetic_of_the_paper() -> None:
    percents = [round(paper_percent(levels), 1) for levels in texture_paper.PAPER_LEVELS]
    assert percents == [23.8, 22.4, 20.8, 18.8, 16.2, 14.5, 12.5]


def profile() -> textures.Profile:
    """10 mm at 0.5 um: 20 000 heights."""
    return textures.surface_profile("rough", 1, 0.2, texture_paper.HAND_SPEED_MM_S, texture_paper.RATE_HZ)


def result(setting: codec.Setting, b0_db: float | None = None) -> Result:
    return measure("rough", code(profile(), setting, b0_db), setting, b0_db)


def test_huffman_ratios_count_no_table_and_files_do() -> None:
    coarse, fine = result({"levels": 5}), result({"levels": 14})
    assert coarse.huffman_percent < fine.huffman_percent < fine.paper_percent
    assert coarse.huffman_percent < coarse.file_percent
    assert fine.snr_db > coarse.snr_db + 5
    assert coarse.zeros_percent > fine.zeros_percent > 0
    assert result({"levels": 14, "quantiser": "log"}).zeros_percent == 0


def test_huffman_bits_are_those_of_the_counts() -> None:
    assert texture_paper.huffman_bits(np.array([1.0, 1, 1, 1, 2, 2, 3])) == 4 * 1 + 2 * 2 + 1 * 2
    assert texture_paper.huffman_bits(np.zeros(5)) == 5


def test_a_higher_cut_gives_more_zeros_and_less_of_the_signal() -> None:
    results = [result({"levels": texture_paper.SIXTEEN_BITS}, b0_db) for b0_db in (-12.0, 0.0, 12.0)]
    zeros, snrs_db = [each.zeros_percent for each in results], [each.snr_db for each in results]
    assert 0 < zeros[0] < zeros[1] < zeros[2] <= 100
    assert snrs_db == sorted(snrs_db, reverse=True)
    assert texture_paper.b0_of_share(results, (zeros[0] + zeros[1]) / 2) == pytest.approx(-6)


def test_coefficients_are_those_of_the_whole_profile_up_to_400_hz() -> None:
    coded = code(profile(), {"levels": texture_paper.SIXTEEN_BITS})
    assert coded.original_um.shape == coded.coded_um.shape == (1, 160)
    np.testing.assert_allclose(coded.frequency_hz[[0, -1]], [2.5, 400])
    np.testing.assert_allclose(coded.coded_um, coded.original_um, atol=1e-3)


def test_falls_are_found_between_neighbours() -> None:
    results = [Result("t", "linear", n, None, 0, 0, 0, 0, snr_db) for n, snr_db in ((6, 2.0), (4, 1.0), (5, 3.0))]
    assert texture_paper.falls(results) == {6: 1.0}
