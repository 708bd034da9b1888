"""The page of the perceptual modes: what it measures of one recording, and the page as it stands."""

from dataclasses import replace

import pytest

import vibrocast
from studies import perceptual as study
from vibrocast.textures import Recording


@pytest.fixture(scope="module")
def recording() -> Recording:
    return replace(vibrocast.load("examples/oak.wav"), name="oak")


def test_a_purpose_is_compared_with_none_at_equal_quality(recording: Recording) -> None:
    curves = {purpose: study.curve(recording, purpose) for purpose in (None, "spqi", "threshold")}
    rows = study.compared("oak", curves)
    percent = {(row.purpose, row.quality): row.percent for row in rows}
    assert percent["threshold", "weighted SNR at the skin"] < 0 < percent["threshold", "SNR"]
    skins = {(row.snr_db, row.purpose): row for row in study.skins("oak", curves)}
    assert skins[10.0, ""].coded_snr_db == pytest.approx(10.0, abs=0.1)
    assert skins[10.0, "threshold"].weighted_db > skins[10.0, ""].weighted_db


def test_slow_noise_is_relative_to_the_recording_there(recording: Recording) -> None:
    assert study.slow_noise_db(recording, 0 * recording.samples) == pytest.approx(0.0)
    assert study.slow_noise_db(recording, 0.9 * recording.samples) == pytest.approx(-20.0)


def test_the_page_states_the_worst_recording() -> None:
    bd = [study.BdRow(name, "spqi", "SPQI", percent) for name, percent in (("a", -20.0), ("b", -10.0))]
    bd += [replace(row, quality="SNR", percent=4.0) for row in bd]
    skins = [
        study.SkinRow(name, snr_db, purpose, 1.0, snr_db, 5.0, snr_db + more, -3.0)
        for name in ("a", "b")
        for snr_db in study.QUALITIES_DB
        for purpose, more in (("", 1.0), ("spqi", 1.0), ("threshold", 6.0))
    ]
    unfelt = [
        study.UnfeltRow(name, purpose, masking, 2.0 - masking - 0.5 * bool(purpose), 30.0 - 10 * masking)
        for name in ("a", "b")
        for purpose in ("", "threshold")
        for masking in (False, True)
    ]
    page = study.page(bd, skins, unfelt)
    assert "takes 15.0 % fewer bits at equal SPQI, and 4.0 % more at equal SNR" in page
    assert "brings 5.0 dB more weighted SNR" in page
    assert "falls from 30 to 20 dB" in page
