"""The chart of quality against the load of processors: which curve, load and memory stand for a decoder."""

import pytest

from studies import embedded_load
from studies.firmware import Load, Size
from tests.studies.test_papers import curve
from vibrocast.evaluation.comparison import Measurements
from vibrocast.evaluation.cost import CodecCost

LOADS = [
    Load(decoder, texture, 10.0, 0.5, core, kernels, factor * instructions, cycles, 1000)
    for decoder, factor in (("slp", 1), ("eva-16", 3))
    for texture, instructions in (("wood", 900.0), ("taps", 1100.0))
    for core, kernels, cycles in (("M4F", "DSP instructions", factor * 1200.0), ("M0+", "portable C", None))
]
SIZES = [
    Size(decoder, kernels, 10_000, image_bytes, 2000, 0, 0)
    for decoder, image_bytes in (("slp", 0), ("eva-16", 5000), ("parametric", 0))
    for kernels in ("DSP instructions", "portable C")
]


def test_each_decoder_has_its_best_curve_its_mean_load_and_all_its_bytes() -> None:
    points = [*curve("slp", 1), *curve("slp-plain", 0.9), *curve("eva-16", 0.8)]
    measurements = Measurements(points, [], [CodecCost("eva-16", 1, 1, "", 1000, "eva", 16)], [])
    table = embedded_load.rows(measurements, LOADS, SIZES).filter(quality="snr_db")
    assert table.select("codec", "curve").unique(maintain_order=True).rows() == [
        ("slp", "slp-plain"),
        ("eva-16", "eva-16"),
    ]
    assert table["per_sample"].to_list() == [1200, 1000, 3600, 3000]
    assert table["load_percent"].to_list() == pytest.approx([2.0, 2.105, 6.0, 6.316], abs=0.001)
    assert table["memory_bytes"].to_list() == [12_000, 12_000, 17_000, 17_000]
