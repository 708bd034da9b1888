"""Step shapes: from a signal, from the threshold of touch, as a parameter; and streams that are coded for a purpose."""

import numpy as np
import pytest

import vibrocast
from tests.codec.signals import texture
from vibrocast import codec
from vibrocast.codec import CodecError, mdct, shaping
from vibrocast.codec.encoding import encode_recording
from vibrocast.codec.rate_controlled import RateTarget
from vibrocast.codec.rate_controlled import encode as encode_rate_controlled
from vibrocast.codec.threshold import read_threshold, skin_power, skin_snr_db
from vibrocast.textures import GENERATORS, Recording


def rough(unit: str = "m/s^2") -> Recording:
    return Recording(GENERATORS["rough"](seconds=2.0, rate_hz=2800).samples, 2800.0, unit, "rough")


def test_steps_follow_the_fourth_root_of_the_power() -> None:
    time_s = np.arange(5600) / 2800
    tone, noise = np.sin(2 * np.pi * 87.5 * time_s), np.random.default_rng(1).normal(0, 1.0, 5600)
    assert shaping.signal_shape(noise[:, None]) == pytest.approx([0] * 7, abs=0.2)
    shape = shaping.signal_shape((tone + 0.001 * noise)[:, None])
    assert int(np.argmin(shape)) == 2  # the node at 1/16 of half the rate
    # All others lie at the floor, 15 dB below it.
    assert max(shape) == pytest.approx(0.25 * np.log2(1 + 10**1.5), abs=0.01)
    assert shaping.signal_shape(np.zeros((100, 2))) == (0.0,) * 7


def test_the_level_of_a_signal_does_not_matter() -> None:
    signal = texture(3000, 2)
    louder = signal * np.array([3.0, 100.0])
    assert shaping.signal_shape(louder) == pytest.approx(shaping.signal_shape(signal))
    one, other = (shaping.threshold_shape(2800, "m/s^2", each) for each in (signal, louder))
    assert one == pytest.approx(other)


def test_steps_follow_the_threshold_in_the_unit_of_the_stream() -> None:
    acceleration, displacement = (np.array(shaping.threshold_shape(8000, unit)) for unit in ("m/s^2", "um"))
    # From node 2 to node 3, 250 to 500 Hz, displacement of one acceleration falls by two octaves.
    assert acceleration[3] - acceleration[2] - (displacement[3] - displacement[2]) == pytest.approx(2.0)


def test_steps_are_fine_below_40_hz_only_where_the_recording_is_weak() -> None:
    time_s = np.arange(5600) / 2800
    fast, slow = (np.sin(2 * np.pi * hz * time_s)[:, None] for hz in (100.0, 30.0))
    weak, strong = (np.array(shaping.threshold_shape(2800, "m/s^2", fast + part * slow)) for part in (0.0, 1.0))
    assert weak[2] - weak[0] > 3 + strong[2] - strong[0]


def test_a_shape_is_text_with_seven_octaves() -> None:
    octaves = (0.0, 1.5, 14.0, 0.25, 3.0, 2.0, 1.0)
    assert shaping.parsed_shape(shaping.shape_text(octaves)) == octaves
    assert shaping.parsed_shape("flat") is None
    for text in ("0/1", "0/0/0/0/0/0/15", "0/0/0/0/0/0/-1", "0/0/0/0/0/0/nan", "a/b/c/d/e/f/g", ""):
        with pytest.raises(CodecError, match="shape"):
            shaping.parsed_shape(text)


def test_a_packed_shape_keeps_octaves_within_its_unit() -> None:
    packed, mean = mdct.packed_shape((0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0))
    unit = (packed[0] & 15) / 16
    values = [nibble for byte in packed for nibble in (byte & 15, byte >> 4)][1:]
    assert [unit * each for each in values] == pytest.approx([0, 1, 2, 3, 4, 5, 6], abs=unit / 2)
    assert mean == pytest.approx(unit * np.mean(values))
    assert mdct.packed_shape(None) == mdct.packed_shape((0.0,) * 7) == (b"", 0.0)


@pytest.mark.parametrize("purpose", shaping.PURPOSES)
def test_a_purpose_gives_more_of_its_quality_at_equal_rate(purpose: str) -> None:
    recording = vibrocast.load("examples/oak.wav")
    plain, shaped = (vibrocast.encode(recording, rate_bps=3000, purpose=each) for each in (None, purpose))
    assert plain.quality is not None
    assert shaped.quality is not None
    assert shaped.quality.weighted_skin_snr_db is not None
    assert plain.quality.weighted_skin_snr_db is not None
    assert shaped.quality.weighted_skin_snr_db > plain.quality.weighted_skin_snr_db + 0.5
    spqis = [
        vibrocast.measure(recording.samples[: len(each.decode())], each.decode(), 2800, recording.unit).spqi
        for each in (plain, shaped)
    ]
    assert spqis[0] is not None
    assert spqis[1] is not None
    assert spqis[1] > spqis[0] + 0.02


@pytest.mark.parametrize("snr_db", [8.0, 20.0])
def test_for_the_threshold_the_target_is_the_weighted_snr(snr_db: float) -> None:
    encoding = encode_recording(rough(), snr_db=snr_db, purpose="threshold")
    quality = encoding.quality
    assert quality.note is None
    assert quality.weighted_skin_snr_db == pytest.approx(snr_db, abs=0.2)
    assert quality.snr_db is not None
    assert abs(quality.snr_db - snr_db) > 1


def test_a_long_recording_meets_the_weighted_snr_too() -> None:
    samples = np.tile(rough().samples, (60, 1))
    encoding = encode_recording(Recording(samples, 2800.0, "m/s^2", "long"), snr_db=12.0, purpose="threshold")
    assert encoding.quality.weighted_skin_snr_db == pytest.approx(12.0, abs=0.2)


@pytest.mark.parametrize(
    ("unit", "codec_name", "purpose", "flaw"),
    [
        ("full scale", "mdct", "threshold", "relative to full scale"),
        ("m/s^2", "slp", "spqi", "slp cannot code for a purpose"),
        ("m/s^2", "mdct", "touch", "'touch'; choose one of spqi, threshold"),
    ],
)
def test_a_purpose_that_cannot_be_met_is_an_error(unit: str, codec_name: str, purpose: str, flaw: str) -> None:
    with pytest.raises(CodecError, match=flaw):
        encode_recording(rough(unit), codec_name=codec_name, purpose=purpose)


def test_a_live_stream_does_not_know_its_spectrum() -> None:
    with pytest.raises(CodecError, match="whole recording"):
        shaping.shape_for("spqi", None, 2800, "m/s^2")
    assert len(shaping.shape_for("threshold", None, 2800, "m/s^2")) == 7


def test_a_rate_controlled_stream_keeps_its_shape() -> None:
    stream, outcome = encode_rate_controlled(rough(), RateTarget(constant_rate_bps=6000), purpose="threshold")
    assert outcome.sent_bps == pytest.approx(6000, rel=0.05)
    assert stream.header.configuration[-5] == 5  # features: rate control and a shape


def test_a_given_shape_stands_before_a_purpose() -> None:
    source = codec.Source(rough().samples, 2800, unit="m/s^2", purpose="threshold")
    assert source.resolved({"shape": "flat"})["shape"] == "flat"
    assert source.resolved({})["shape"] != "flat"


def test_skin_power_is_that_of_displacement() -> None:
    time_s = np.arange(28000) / 2800
    acceleration = np.stack([(2 * np.pi * hz) ** 2 * np.sin(2 * np.pi * hz * time_s) for hz in (50.0, 200.0)], axis=1)
    power_um = skin_power(1e-6 * acceleration, 2800, "m/s^2")
    assert power_um[0] == pytest.approx(power_um[1], rel=0.05)
    displacement = np.stack([np.sin(2 * np.pi * hz * time_s) for hz in (50.0, 200.0)], axis=1)
    assert skin_power(displacement, 2800, "um") == pytest.approx(power_um, rel=0.05)
    weighted = skin_power(displacement, 2800, "um", read_threshold())
    rows = read_threshold()
    db = np.interp(np.log([50.0, 200.0]), np.log(rows[:, 0]), rows[:, 1])
    assert 10 * np.log10(weighted[1] / weighted[0]) == pytest.approx(db[0] - db[1], abs=0.2)


def test_skin_snr_of_a_scaled_copy_is_that_of_the_signal() -> None:
    samples = rough().samples
    assert skin_snr_db(samples, 0.9 * samples, 2800, "m/s^2") == pytest.approx(20.0)
    assert skin_snr_db(samples, 0.9 * samples, 2800, "m/s^2", read_threshold()) == pytest.approx(20.0)
    assert skin_snr_db(samples, samples, 2800, "m/s^2") is None
