"""Profiles under a hand from the command line: coding, properties, movements, playing, rejections."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import Result
from numpy.typing import NDArray
from scipy.fft import dct

from tests.codec.test_dct_equations import B0_DB, PAPER_RULES, heights_um
from tests.command import fails, run, succeeds
from tests.conftest import linked, noise, texture
from vibrocast import codec, textures
from vibrocast.codec.encoding import encode_profile, profile_recording
from vibrocast.codec.stream import Stream, read_stream
from vibrocast.codec.threshold import read_threshold, threshold_amplitude
from vibrocast.device_protocol.coded_stream import StreamError
from vibrocast.errors import InputError
from vibrocast.host import hand_playback
from vibrocast.host.controller import Controller, ControllerError
from vibrocast.host.devices import session_with
from vibrocast.host.stream_session import playable
from vibrocast.output.actuator import PIEZO_STACK
from vibrocast.simulated_device.controller import Settings
from vibrocast.simulated_device.faulty_wire import Fault

PROFILE = Path(__file__).parents[2] / "examples" / "leather_profile.csv"


@pytest.fixture
def stream() -> Stream:
    return encode_profile(profile_recording(PROFILE), snr_db=20.0).stream


def test_profile_coded_keeps_the_band_that_the_slowest_hand_feels() -> None:
    for slowest_mm_s in (10.0, 40.0):
        encoding = encode_profile(profile_recording(PROFILE), slowest_mm_s, snr_db=25.0)
        header = encoding.stream.header
        assert header.spatial and 1 <= header.rate_hz / (400 / slowest_mm_s * 1000 / 0.34) < 1.1
        # A controller repeats a multiple of a power of two: here of the profile's length.
        assert header.samples is not None and header.samples % 128 == 0
        assert header.samples / header.rate_hz == pytest.approx(profile_recording(PROFILE).seconds, rel=1e-4)
        assert encoding.quality.snr_db == pytest.approx(25.0, abs=0.5)
        # Nothing is left that would be rendered with images.
        samples = encoding.recording.samples[:, 0]
        spectrum = np.abs(np.fft.rfft(samples * np.hanning(len(samples))))
        assert spectrum[np.fft.rfftfreq(len(samples)) > 0.45].max() < 1e-3 * spectrum.max()


@pytest.mark.parametrize("setting", [{}, {"smallest": 0.05, "levels": 14}])
def test_dct_keeps_the_whole_band_of_a_profile(setting: codec.Setting) -> None:
    """Its limit at 400 Hz holds at one hand speed, so blocks have none by default."""
    recording = profile_recording(PROFILE)
    snr_db = encode_profile(recording, codec_name="dct", setting=setting).quality.snr_db
    assert snr_db is not None and snr_db > 13


@pytest.mark.parametrize(("hand_speed_mm_s", "highest_per_mm"), [(50.0, 8), (25.0, 16)])
def test_the_limit_and_the_cut_hold_at_a_hand_speed(hand_speed_mm_s: float, highest_per_mm: float) -> None:
    """400 Hz are 8 waves per mm at 50 mm/s."""
    fixed: codec.Setting = {"block": "whole", "levels": 65535, "hand_speed_mm_s": hand_speed_mm_s}
    recording = profile_recording(PROFILE)

    def spectrum(setting: codec.Setting) -> NDArray[np.float64]:
        heights_um = encode_profile(recording, codec_name="dct", setting={**fixed, **setting}).stream.decode()
        return np.abs(dct(heights_um[:, 0], norm="ortho"))

    whole, cut = spectrum({}), spectrum({"threshold": "on", "b0_db": 0})
    waves_per_mm = np.arange(len(whole)) / 2 / (1000 * recording.seconds)
    assert np.max(whole[waves_per_mm > 1.01 * highest_per_mm]) < 0.02 < np.median(whole[waves_per_mm < highest_per_mm])
    amplitudes_um = whole * np.sqrt(2 / len(whole))
    felt_um = threshold_amplitude(read_threshold(), waves_per_mm * hand_speed_mm_s, "um")
    inside = (waves_per_mm < 0.99 * highest_per_mm) & (np.abs(amplitudes_um / felt_um - 1) > 0.1)
    np.testing.assert_array_equal((cut > 0.02)[inside], (amplitudes_um > felt_um)[inside])


@pytest.mark.parametrize("block", ["512", "whole"])
def test_a_cut_that_cannot_reach_the_default_snr_is_coded_as_it_is(block: str) -> None:
    recording, setting = profile_recording(PROFILE), {"block": block, "threshold": "on"}
    encoding = encode_profile(recording, codec_name="dct", setting=setting)
    assert 2 < (encoding.quality.snr_db or 0) < 8
    assert "the rest of the setting has its defaults" in (encoding.quality.note or "")
    with pytest.raises(codec.CodecError, match="cannot be met"):
        encode_profile(recording, codec_name="dct", setting=setting, snr_db=14.8)


def test_a_profile_too_short_to_repeat_is_rejected() -> None:
    fine = textures.Recording(np.random.default_rng(1).standard_normal((100, 1)), 2e5, "um", "fine")
    with pytest.raises(StreamError, match=r"0\.5 mm are too short .* at least 0\.64 mm"):
        encode_profile(fine)


def test_a_crossfade_makes_the_ends_meet() -> None:
    ramp = textures.Recording(np.linspace(-9, 9, 1600)[:, None], 1e5, "um", "ramp")
    for crossfade, samples, jump_um in ((False, 1920, 18.0), (True, 1792, 0.0)):
        stream = encode_profile(ramp, 10.0, crossfade=crossfade, setting={"step": 0.001}).stream
        heights_um = stream.decode()[:, 0]
        assert len(heights_um) == samples
        assert abs(heights_um[0] - heights_um[-1]) == pytest.approx(jump_um, abs=0.3)


def test_too_slow_a_hand_is_rejected_with_the_slowest_that_can_be() -> None:
    fine = textures.Recording(np.random.default_rng(1).standard_normal((4000, 1)), 1e6, "um", "fine")
    with pytest.raises(Exception, match=r"slowest hand speed of 5\.88 mm/s"):
        encode_profile(fine, 1.0)


def test_command_says_what_a_spatial_stream_is(tmp_path: Path) -> None:
    coded, decoded = tmp_path / "a.vct", tmp_path / "a.csv"
    succeeds("encode", PROFILE, coded, "--snr-db", 20)
    assert "samples per metre" in succeeds("info", coded)
    succeeds("decode", coded, decoded)
    assert textures.load(decoded, hand_speed_mm_s=50).unit == "um"
    assert "into a CSV file" in fails(2, "decode", coded, tmp_path / "a.wav")
    assert "--hand-speed-mm-s" in fails(2, "play", coded, "--hand", 3)
    assert "--snr-db" in fails(2, "encode", PROFILE, coded, "--rate-bps", 900)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "first line"),
        ("time_s,position_mm\n0,1\n", "at least two"),
        ("time_s,position_mm\n0,1\n0,2\n", "line 3: times must rise"),
        ("time_s,position_mm\n0,1\n1,x\n", "line 3 is not two numbers"),
        ("time_s,position_mm\n0,nan\n1,1\n", "within 1e"),
        ("time_s,position_mm\n0,1,2\n", "line 2 is not two numbers"),
    ],
)
def test_movements_that_cannot_be_read_are_rejected(tmp_path: Path, text: str, reason: str) -> None:
    path = tmp_path / "hand.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=reason):
        hand_playback.read_movement(path)


def test_movement_is_read_and_made(tmp_path: Path) -> None:
    path = tmp_path / "hand.csv"
    path.write_text("time_s,position_mm\n2,1\n2.5,3.5\n")
    movement = hand_playback.read_movement(path)
    assert (movement.seconds, movement.fastest_mm_s) == (0.5, 5.0)
    strokes = hand_playback.back_and_forth(20.0, 100.0, 2)
    assert strokes.fastest_mm_s == pytest.approx(100.0, rel=1e-3)
    assert np.max(strokes.positions_mm) == pytest.approx(20.0, rel=1e-3)
    assert strokes.positions_mm[-1] == pytest.approx(0.0, abs=1e-6)


def test_the_played_samples_are_the_computed_ones_also_over_a_link_that_loses_frames(stream: Stream) -> None:
    """Lost packets are sent again; where positions are lost as well, only they make a difference."""
    movement = hand_playback.back_and_forth(10.0, 120.0, 1)
    for lost, alike in ((0.0, True), (0.2, False)):
        _, controller = linked(faults=[Fault(lost=lost, direction="to_controller")], seed=2)
        played = hand_playback.play(controller, stream, movement)
        session = session_with(controller, "sim")
        _, expected = hand_playback.computed(session, stream, played)
        assert hand_playback.as_computed(session, played, expected) is alike
        first = PIEZO_STACK.dac_rate_hz // 20
        codes = played.captured.samples[first : len(expected) - 2 * first, 0]
        assert np.corrcoef(codes, expected[first : first + len(codes), 0])[0, 1] > 0.9
        assert played.status.lost_packets == 0


@pytest.mark.parametrize("drift_ppm", [-10_000, 10_000])
def test_clocks_that_drift_and_sparse_positions_make_no_difference(stream: Stream, drift_ppm: int) -> None:
    times_s = np.arange(0, 4, 0.05)
    movement = hand_playback.Movement(times_s, 10 * np.sin(6 * times_s))
    _, controller = linked(Settings(drift_ppm=drift_ppm))
    played = hand_playback.play(controller, stream, movement)
    session = session_with(controller, "sim")
    _, expected = hand_playback.computed(session, stream, played)
    assert hand_playback.as_computed(session, played, expected) is True
    assert played.status.underruns == 0
    other = replace(played, captured=played.captured._replace(samples=played.captured.samples + 1))
    assert hand_playback.as_computed(session, other, expected) is False
    late = replace(other, status=replace(played.status, underruns=1))
    assert hand_playback.as_computed(session, late, expected) is None


PAPER_SETTINGS: dict[str, codec.Setting] = {
    "linear": {"levels": 14},
    "log": {"levels": 14, "quantiser": "log"},
    "cut": {"levels": 65535, "threshold": "on", "b0_db": B0_DB},
}


@pytest.mark.parametrize("material", ["wood", "sandpaper", "leather"])
@pytest.mark.parametrize("rule", PAPER_SETTINGS)
def test_the_papers_chain_from_end_to_end(rule: str, material: str, tmp_path: Path, sim: Controller) -> None:
    """20 000 heights over 10 mm, one transform, levels or cut, Huffman code, 50 mm/s, repeated every 10 mm."""
    heights, coded = tmp_path / "10mm.csv", tmp_path / "10mm.vct"
    textures.save_profile(heights, textures.Profile(heights_um(material), 0.5, material))
    settings = {"block": "whole", "dc": "drop", **PAPER_SETTINGS[rule]}
    options = [option for name, value in settings.items() for option in ("--setting", f"{name}={value}")]
    succeeds("encode", heights, coded, "--codec", "dct", *options)
    stream = read_stream(coded)
    # Each coefficient takes its level, although a controller's samples lie 16 times as far apart.
    _, by_equations = PAPER_RULES[rule]
    decoded_um = stream.decode()[:, 0]
    decided_um = dct(decoded_um, norm="ortho")[1:161] * np.sqrt(2 / len(decoded_um))
    flat_um = textures.load_profile(heights).without_form()
    own_um = dct(flat_um, norm="ortho")[1:161] * np.sqrt(2 / len(flat_um))
    assert np.mean(np.isclose(decided_um, by_equations(own_um, 14), rtol=0.005, atol=2e-3)) >= 0.98
    # The controller gets it in another codec, 60 dB above the error.
    sent = playable(stream)
    assert (codec.snr_db(stream.decode(), sent.decode()) or 0) > 60
    movement = hand_playback.Movement(np.array([0.0, 0.7]), np.array([0.0, 35.0]))
    stroke = hand_playback.play_and_compare(session_with(sim, "sim"), material, stream, movement)
    assert stroke.report.dac_equals_offline and stroke.report.stream_bytes == stream.size_bytes
    period = PIEZO_STACK.dac_rate_hz // 5  # 10 mm at 50 mm/s
    made_um, skin_um = stroke.traces[0].values[period:, 0], stroke.traces[1].values[4 * period :, 0]
    one_code_um = PIEZO_STACK.excursion_um / PIEZO_STACK.full_scale
    assert np.max(np.abs(skin_um[: 4 * period] - skin_um[4 * period : 8 * period])) <= 1.01 * one_code_um
    np.testing.assert_array_equal(made_um[:period], made_um[period : 2 * period])
    # The output follows the hand 28 ms late. Compared below 400 Hz, because the seam has all frequencies.
    spectra = [np.fft.rfft(decoded_um) / len(decoded_um), np.fft.rfft(made_um[:period]) / period]
    lag = np.exp(-2j * np.pi * np.arange(80) * 0.028 * 5)
    signal, error = spectra[0][:80], spectra[1][:80] - spectra[0][:80] * lag
    assert 10 * np.log10(np.sum(np.abs(signal) ** 2) / np.sum(np.abs(error) ** 2)) > 45


@pytest.mark.usefixtures("simulated_time")
def test_a_whole_transform_plays_in_time(tmp_path: Path) -> None:
    recording, coded = tmp_path / "a.wav", tmp_path / "a.vct"
    textures.save(recording, texture(noise(0.36), "m/s^2"))
    succeeds("encode", recording, coded, "--codec", "dct", "--setting", "block=whole", "--setting", "levels=14")
    succeeds("play", coded, "--device", "serial:port")


def test_controllers_that_cannot_are_named(stream: Stream) -> None:
    for samples, reason in ((0, "update its firmware"), (100, "controller holds 100")):
        _, controller = linked(Settings(profile_samples=samples))
        with pytest.raises(ControllerError, match=reason):
            hand_playback.load(controller, stream)


def stroked(folder: Path, limits: str, *options: object, actuator: str = PIEZO_STACK.name) -> Result:
    """Play the profile under a hand on a bench with these limits."""
    bench = folder / "bench.toml"
    bench.write_text(
        '[[controllers]]\nname = "it"\naddress = "serial:port"\n'
        f'[[actuators]]\nmodel = "{actuator}"\n[limits]\n{limits}\n'
    )
    hand = ("--hand", "10", "--hand-speed-mm-s", "60")
    return run("play", PROFILE, *hand, "--bench", bench, *options)


@pytest.mark.usefixtures("simulated_time")
def test_a_bench_file_judges_a_profile_under_a_hand(tmp_path: Path) -> None:
    """As any playback: its actuator, its limits, the comparison, the report."""
    report, kept = tmp_path / "stroke.json", "min_snr_db = 5\nmin_gain = 0.8\nmax_bad_frames = 0\nmax_lost_percent = 0"
    done = stroked(tmp_path, kept, "--json", "--report", report)
    assert done.exit_code == 0, done.output
    told = json.loads(report.read_text())
    assert json.loads(done.stdout) == told
    assert told["run"]["bench_sha256"] and told["device"]["address"] == "serial:port"
    assert (
        told["position"]["positions"] > 200
        and told["dac_equals_offline"] is True
        and told["quality"]["skin"]["snr_db"] > 5
    )
    done = stroked(tmp_path, "min_snr_db = 100")
    assert done.exit_code == 4 and "min_snr_db = 100" in done.stderr
    done = stroked(tmp_path, "", actuator="lra")
    assert done.exit_code == 2 and "the bench has lra there" in done.stderr


@pytest.mark.usefixtures("simulated_time")
@pytest.mark.parametrize(("equal", "exit_code"), [(True, 0), (False, 1), (None, 4)])
def test_a_profile_that_is_not_played_as_computed_fails(
    equal: bool | None, exit_code: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(hand_playback, "as_computed", lambda *_: equal)
    assert stroked(tmp_path, "").exit_code == exit_code
