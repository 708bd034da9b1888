"""The public API: plain arrays and bytes in and out."""

import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import soundfile

import vibrocast
from tests.conftest import noise, texture
from vibrocast import api, codec
from vibrocast.codec import registry

RATE_HZ = 2800
TIMES_S = np.arange(RATE_HZ) / RATE_HZ
TEXTURE = np.sin(2 * np.pi * 150 * TIMES_S) + 0.3 * np.random.default_rng(0).normal(size=RATE_HZ)


def test_encodes_stores_decodes_measures_and_plays(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    stream = vibrocast.encode(TEXTURE, rate_hz=RATE_HZ, unit="m/s^2", snr_db=15)
    data = bytes(stream)
    assert vibrocast.Stream.from_bytes(data) == stream
    stream.save(tmp_path / "wood.vct")
    decoded = vibrocast.decode(data)
    for source in (stream, tmp_path / "wood.vct", str(tmp_path / "wood.vct")):
        np.testing.assert_array_equal(vibrocast.decode(source).samples, decoded.samples)
    assert (decoded.samples.shape, decoded.rate_hz, decoded.unit) == ((RATE_HZ, 1), RATE_HZ, "m/s^2")
    quality = vibrocast.measure(TEXTURE[:, None], decoded.samples, rate_hz=RATE_HZ, unit="m/s^2")
    assert vibrocast.measure(TEXTURE[:, None], decoded, RATE_HZ, "m/s^2") == quality
    assert quality.snr_db == pytest.approx(15, abs=0.3)
    skin = vibrocast.render(stream, actuator="piezo-stack")
    assert skin.unit == "um" and skin.seconds == pytest.approx(1.0)
    with vibrocast.connect("sim") as controller:
        report = controller.play(stream)
        assert controller.status()["hardware"]
    assert stream.quality is not None
    assert report.dac_equals_offline and report.quality.snr_db == stream.quality.snr_db
    assert capfd.readouterr() == ("", ""), "a library prints nothing"


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64, np.longdouble, np.int8, np.int16, np.int32])
def test_takes_every_real_dtype(dtype: Any) -> None:
    values = (100 * TEXTURE / np.max(np.abs(TEXTURE))).astype(dtype)
    decoded = vibrocast.decode(vibrocast.encode(values, RATE_HZ, "m/s^2", snr_db=20))
    assert vibrocast.measure(values, decoded.samples[:, 0], RATE_HZ, "m/s^2").snr_db == pytest.approx(20, abs=0.5)


def test_takes_lists_channels_and_recordings() -> None:
    two = np.stack([TEXTURE, -TEXTURE], axis=1)
    recording = vibrocast.decode(vibrocast.encode(two.tolist(), RATE_HZ, "g"))
    assert recording.channels == 2
    assert np.max(recording.samples) == pytest.approx(9.80665 * np.max(np.abs(TEXTURE)), rel=0.2)
    assert vibrocast.encode(recording, codec="dct", snr_db=10).codec_name == "dct"


@pytest.mark.parametrize("added", [9.81, -200.0, 30 * TIMES_S], ids=["gravity", "offset", "drift"])
def test_an_offset_or_drift_does_not_change_the_quality(added: Any) -> None:
    clean, moved = (vibrocast.encode(TEXTURE + part, RATE_HZ, "m/s^2", snr_db=15) for part in (0.0, added))
    assert clean.quality is not None and moved.quality is not None
    assert moved.quality.snr_db == pytest.approx(clean.quality.snr_db, abs=0.01)
    assert moved.quality.weighted_skin_snr_db == pytest.approx(clean.quality.weighted_skin_snr_db, abs=0.05)
    assert moved.quality.removed_below > 0.9 > 0.1 > clean.quality.removed_below
    measured = vibrocast.measure(TEXTURE + added, vibrocast.decode(moved).samples[:, 0], RATE_HZ, "m/s^2")
    assert measured.snr_db == pytest.approx(15, abs=0.3)


def test_the_whole_band_is_kept_on_request() -> None:
    stream = vibrocast.encode(TEXTURE + 9.81, RATE_HZ, "m/s^2", highpass_hz=None, snr_db=15)
    assert np.mean(vibrocast.decode(stream).samples) == pytest.approx(9.81, rel=0.2)
    drive = vibrocast.encode(TEXTURE / 10 + 0.5, RATE_HZ, "drive", snr_db=30)
    assert np.mean(vibrocast.decode(drive).samples) == pytest.approx(0.5, rel=0.1)


def test_a_signal_of_unknown_size_is_no_silent_guess() -> None:
    stream = vibrocast.encode(TEXTURE / 10, RATE_HZ)
    with pytest.raises(ValueError, match="`unit` drive"):
        vibrocast.render(stream)
    with vibrocast.connect("sim") as controller, pytest.raises(ValueError, match="`unit` drive"):
        controller.play(stream)
    assert np.max(vibrocast.render(stream, unit="drive").samples) > 0.1


def test_damaged_bytes_are_an_error() -> None:
    data = bytes(vibrocast.encode(TEXTURE, RATE_HZ))
    for damaged in (b"", data[:-1], data[:20] + bytes((data[20] ^ 1,)) + data[21:]):
        with pytest.raises(ValueError, match=r"stream|vct"):
            vibrocast.decode(damaged)


def test_level_and_actuator_are_your_own(tmp_path: Path) -> None:
    stream = vibrocast.encode(TEXTURE, RATE_HZ, "m/s^2", snr_db=15)
    quiet, loud = (vibrocast.render(stream, gain_db=gain_db).samples for gain_db in (-6.0, 0.0))
    assert np.std(loud) / np.std(quiet) == pytest.approx(10 ** (6 / 20), rel=0.01)
    (tmp_path / "mine.toml").write_text('name = "mine"\nmodel = "lra"\ncorner_hz = 160\n')
    with vibrocast.connect("sim", actuator=tmp_path / "mine.toml") as controller:
        report = controller.play(stream, gain_db=-20)
    assert report.actuator.name == "mine" and report.dac_equals_offline


def test_encodes_a_wav_file_of_known_unit(tmp_path: Path) -> None:
    soundfile.write(tmp_path / "wood.wav", TEXTURE / 50, RATE_HZ, subtype="FLOAT")
    recording = vibrocast.load(tmp_path / "wood.wav", unit="m/s^2", full_scale=50)
    np.testing.assert_allclose(recording.samples[:, 0], TEXTURE, atol=1e-5)
    stream = vibrocast.encode(recording, snr_db=15)
    assert stream.header.unit == "m/s^2"
    assert stream.quality is not None and stream.quality.snr_db == pytest.approx(15, abs=0.3)


class Rounded:
    """A codec without a package."""

    name, summary, block_samples, qualities = "rounded", "rounds", 16, range(1, 15)

    def encode(self, samples: Any, quality: float) -> bytes:
        return bytes(np.rint(samples * 2**quality).astype("<i2").tobytes())

    def decode(self, data: bytes, samples: int, channels: int, quality: float) -> Any:
        return np.frombuffer(data, "<i2").reshape(samples, channels) / 2**quality


@pytest.fixture
def own_registry(monkeypatch: pytest.MonkeyPatch) -> None:
    own = registry.Codecs()
    for module in (registry, codec, api):
        monkeypatch.setattr(module, "CODECS", own)


@pytest.mark.usefixtures("own_registry")
def test_a_registered_codec_is_as_any_other() -> None:
    count = len(vibrocast.codecs())
    for each in (Rounded, Rounded()):  # as where a cell of a notebook runs again
        assert vibrocast.register(each) is vibrocast.codecs()["rounded"]
    assert len(vibrocast.codecs()) == len(list(vibrocast.codecs())) == count + 1
    stream = vibrocast.encode(TEXTURE, RATE_HZ, "m/s^2", codec="rounded", snr_db=20)
    assert vibrocast.Stream.from_bytes(bytes(stream)).codec_name == "rounded"
    with vibrocast.connect("sim") as controller:
        assert controller.play(stream).decoded_equals_offline


@pytest.mark.usefixtures("own_registry")
@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"name": "mdct"}, "there is a codec mdct already"),
        ({"name": 5}, "its name must be"),
        ({"name": "n" * 65}, "its name must be"),
        ({"qualities": ()}, "finite numbers, at least one"),
        ({"qualities": 3}, "finite numbers, at least one"),
        ({"qualities": ["a"]}, "finite numbers, at least one"),
        ({"block_samples": "16"}, "its block_samples is 16"),
        ({"block_samples": 0}, "its block_samples is 0"),
        ({"encode": None}, "it lacks name"),
        ({"__init__": lambda self, needed: None}, "cannot be called without arguments"),
    ],
)
def test_an_unusable_codec_is_not_registered(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=f"^`codec` cannot be registered: .*{message}"):
        vibrocast.register(type("Unusable", (Rounded,), changes))
    with pytest.raises(ValueError, match="it lacks name"):
        vibrocast.register(None)  # type: ignore[arg-type]


STREAM = vibrocast.encode(TEXTURE, RATE_HZ, "m/s^2", codec="dct", setting={"levels": 20})


untyped: Any = vibrocast
"""The package, for arguments that a type checker rejects."""


def connected(*arguments: Any, **options: Any) -> Any:
    with vibrocast.connect(*arguments, **options) as controller:
        return controller


def played(*arguments: Any, **options: Any) -> Any:
    with vibrocast.connect("sim") as controller:
        return controller.play(*arguments, **options)


def encoded(samples: Any = TEXTURE, rate_hz: Any = RATE_HZ, **options: Any) -> Any:
    return vibrocast.encode(samples, rate_hz, **options)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: vibrocast.encode(TEXTURE), "`rate_hz` is missing"),
        (lambda: encoded(TEXTURE[None, None]), "shape (1, 1, 2800)"),
        (lambda: encoded(TEXTURE + 1j), "complex128"),
        (lambda: encoded(["a"]), "store integers or floats"),
        (lambda: encoded([[1.0], [1.0, 2.0]]), "no array of numbers"),
        (lambda: encoded(np.full(100, np.nan)), "sample 0 of channel 0 is nan"),
        (lambda: encoded(np.zeros(0)), "holds no samples"),
        (lambda: encoded(rate_hz=-1.0), "sample rate -1 Hz"),
        (lambda: encoded(rate_hz=30.0), "highpass_hz=None"),
        (lambda: encoded(rate_hz="2800"), "`rate_hz` is of type str"),
        (lambda: encoded(unit=["g"]), "`unit` is of type list"),
        (lambda: encoded(unit="bar"), "`unit`: unknown unit 'bar'"),
        (lambda: encoded(codec=vibrocast.codecs()["mdct"]), "`codec` is of type Codec"),
        (lambda: encoded(setting="step=1"), "`setting` is of type str"),
        (lambda: encoded(setting={"step": None}), "step is None"),
        (lambda: encoded(snr_db="15"), "`snr_db` is of type str"),
        (lambda: encoded(rate_bps=True), "`rate_bps` is of type bool"),
        (lambda: encoded(rate_bps=1000, snr_db=10), "`rate_bps` and `snr_db` are both given"),
        (lambda: encoded(stream_rate_hz=2800.5), "`stream_rate_hz` is 2800.5"),
        (lambda: encoded(highpass_hz="20"), "`highpass_hz` is of type str"),
        (lambda: encoded(progress=5), "`progress` is of type int"),
        (lambda: untyped.encode("wood.wav"), "`samples` is a path"),
        (lambda: untyped.decode(TEXTURE), "`data` is of type ndarray"),
        (lambda: untyped.decode(STREAM, model="eva-16-4"), "leave out `model`"),
        (lambda: untyped.Stream.from_bytes("VCT"), "`data` is of type str"),
        (lambda: vibrocast.measure(TEXTURE, vibrocast.decode(STREAM), RATE_HZ), "`decoded` is in m/s^2 at 2800 Hz"),
        (lambda: untyped.render(None), "`stream` is of type NoneType"),
        (lambda: untyped.render(STREAM, gain_db=1e9), "`gain_db`=1e+09"),
        (lambda: untyped.render(STREAM, "piezo"), "no actuator of that name"),
        (lambda: untyped.render(STREAM, unit="bar"), "`unit` is 'bar'"),
        (lambda: untyped.render(STREAM, unit="drive"), "leave out `unit`"),
        (lambda: connected(runtime="x"), "`runtime` is 'x'"),
        (lambda: played(STREAM, loops=0), "`loops` is 0"),
        (lambda: untyped.load("wood.wav", full_scale="x"), "`full_scale` is of type str"),
        (lambda: untyped.load_profile(None), "`path` is of type NoneType"),
    ],
)
def test_a_wrong_argument_is_an_error_of_one_line(call: Callable[[], Any], message: str) -> None:
    with pytest.raises(ValueError) as raised:
        call()
    assert message in str(raised.value) and "\n" not in str(raised.value) and "--" not in str(raised.value)


def test_a_file_that_cannot_be_read_is_an_error(tmp_path: Path) -> None:
    for path in (tmp_path / "absent.vct", tmp_path):
        with pytest.raises((OSError, ValueError), match=re.escape(str(path))):
            vibrocast.decode(path)


def test_without_its_extra_measure_warns_and_leaves_out_perceptual_scores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "vibromaf", None)
    with pytest.warns(UserWarning, match=r"ST-SIM and SPQI are not measured: .* \[bench\]"):
        quality = vibrocast.measure(TEXTURE, 0.9 * TEXTURE, RATE_HZ, "m/s^2")
    assert quality.snr_db == pytest.approx(20, abs=0.1)
    assert quality.st_sim_2800 is quality.st_sim_8000 is quality.spqi is None


@pytest.mark.usefixtures("simulated_time")
def test_a_list_plays_in_the_background_and_takes_commands() -> None:
    kinds: list[str] = []
    with vibrocast.connect() as connection:
        with pytest.raises(vibrocast.VibrocastError, match="call `start` first"):
            connection.pause()
        recording = texture(noise(0.3, rms=2.0))
        connection.start([recording, vibrocast.encode(recording)], on_event=lambda event: kinds.append(event.kind))
        assert connection.plays
        connection.wait()
        assert not connection.plays and connection.gain_db == 0
        assert kinds.count("track") == 2 and kinds[-1] == "ended"
        connection.start(recording, loops=0)
        connection.gain_db = -6.0
        connection.stop()
        assert connection.status()["status"]["state"] == "stopped"
        connection.start(recording, loops=0)
    assert not connection.plays, "the end of the session ends the list"
