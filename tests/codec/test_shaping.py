"""Step shapes: from the threshold of touch, as a parameter; and streams that are coded for touch."""

import numpy as np
import pytest

import vibrocast
from vibrocast import codec
from vibrocast.codec import CodecError, threshold
from vibrocast.codec.encoding import encode_recording
from vibrocast.codec.rate_control import RateTarget
from vibrocast.codec.threshold import read_threshold, skin_power, skin_snr_db
from vibrocast.textures import GENERATORS, Recording


def rough(unit: str = "m/s^2") -> Recording:
    return Recording(GENERATORS["rough"](seconds=2.0, rate_hz=2800).samples, 2800.0, unit, "rough")


def test_steps_follow_the_threshold_in_the_unit_of_the_stream_up_to_10_db() -> None:
    acceleration, displacement = (np.array(threshold.touch_shape(1, 2800, unit)) for unit in ("m/s^2", "um"))
    db = 20 * np.log10(2)
    # Nodes 3 to 6 are 175, 350, 700 and 1400 Hz; from node to node, displacement of one acceleration falls by 12 dB.
    assert db * (acceleration[3:] - acceleration[3]) == pytest.approx([0, 8.8, 10, 10], abs=0.1)
    assert db * (acceleration[3] - acceleration[2]) == pytest.approx(6)
    assert db * (displacement[0] - displacement[4]) == pytest.approx(7, abs=0.1)
    assert min(acceleration) == min(displacement) == 0


def test_a_shape_is_text_with_seven_octaves() -> None:
    octaves = (0.0, 1.5, 2.7, 0.25, 2.7, 2.0, 1.0)
    assert threshold.parsed_shape(threshold.shape_text(octaves)) == octaves
    assert threshold.parsed_shape("flat") is None
    for text in ("0/1", "0/0/0/0/0/0/2.8", "0/0/0/0/0/0/-1", "0/0/0/0/0/0/nan", "a/b/c/d/e/f/g", ""):
        with pytest.raises(CodecError, match="shape"):
            threshold.parsed_shape(text)


def test_more_touch_gives_more_of_what_is_felt_at_equal_rate() -> None:
    recording = vibrocast.load("examples/oak.wav")
    streams = [vibrocast.encode(recording, rate_bps=3000, touch=each) for each in (0, None, 1)]
    qualities = [each.quality for each in streams]
    weighted_db = [each.weighted_skin_snr_db for each in qualities if each]
    snrs_db = [each.snr_db for each in qualities if each]
    assert weighted_db == sorted(weighted_db)  # type: ignore[type-var]
    assert snrs_db == sorted(snrs_db, reverse=True)  # type: ignore[type-var]
    spqis = [
        vibrocast.measure(recording.samples[: len(each.decode())], each.decode(), 2800, recording.unit).spqi
        for each in streams
    ]
    assert spqis == sorted(spqis)  # type: ignore[type-var]


@pytest.mark.parametrize("touch", [0.0, None, 1.0])
def test_a_target_snr_is_that_of_the_signal_at_every_strength(touch: float | None) -> None:
    quality = encode_recording(rough(), snr_db=12.0, touch=touch).quality
    assert quality.note is None
    assert quality.snr_db == pytest.approx(12, abs=0.2)


def shape_of(unit: str, codec_name: str = "mdct", setting: codec.Setting | None = None) -> codec.Setting:
    return codec.shape_setting(codec.codec_by_name(codec_name), None, 2800, unit, setting)


def test_the_default_shapes_where_the_unit_is_physical_and_the_codec_can() -> None:
    default = threshold.shape_text(threshold.touch_shape(threshold.DEFAULT_TOUCH, 2800, "m/s^2"))
    assert shape_of("m/s^2") == {"shape": default}
    assert shape_of("full scale") == shape_of("m/s^2", "slp") == shape_of("m/s^2", setting={"shape": "flat"}) == {}
    mdct_codec = codec.codec_by_name("mdct")
    assert codec.shape_setting(mdct_codec, 0, 2800, "m/s^2") == {}
    source = codec.Source.of(rough().samples, 2800, unit="m/s^2", shape={"shape": default})
    assert source.resolved({"shape": "flat"})["shape"] == "flat"
    assert source.resolved({})["shape"] == default


@pytest.mark.parametrize(
    ("unit", "codec_name", "touch", "setting", "flaw"),
    [
        ("full scale", "mdct", 0.5, None, "relative to full scale; give `unit` and `full_scale`, or a touch of 0"),
        ("m/s^2", "slp", 0.5, None, "slp cannot shape its error for touch; choose mdct"),
        ("m/s^2", "mdct", 1.5, None, "1.5 is not possible; give 0, flat, to 1"),
        ("m/s^2", "mdct", float("nan"), None, "nan is not possible"),
        ("m/s^2", "mdct", 0.5, {"shape": "flat"}, "both given; give one of them"),
    ],
)
def test_a_strength_that_cannot_be_met_is_an_error(
    unit: str, codec_name: str, touch: float, setting: codec.Setting | None, flaw: str
) -> None:
    with pytest.raises(CodecError, match=flaw):
        encode_recording(rough(unit), codec_name=codec_name, touch=touch, setting=setting)


def test_a_rate_controlled_stream_keeps_its_shape() -> None:
    encoding = encode_recording(rough(), target=RateTarget(constant_rate_bps=6000), touch=1)
    assert encoding.outcome is not None
    assert encoding.outcome.sent_bps == pytest.approx(6000, rel=0.05)
    assert encoding.stream.header.configuration[0] & 4  # a shape
    assert encoding.stream.header.configuration[-1] == 1  # features: rate control


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
