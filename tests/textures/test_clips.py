"""Tests of haptic clips: what each format describes becomes that signal, and no file does harm."""

import json
import re
import tracemalloc
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import hilbert

from tests.textures.hmpg_writer import hmpg, packet, unit
from vibrocast.textures import Recording, TextureError, clips, load
from vibrocast.textures.clips import synthesis

RATE_HZ = 8000
EXAMPLES = sorted((Path(__file__).parents[2] / "examples" / "clips").iterdir())
Json = dict[str, Any]


def event(kind: str, time: float, duration: float | None = None, **parameters: float) -> Json:
    listed = [{"ParameterID": name, "ParameterValue": value} for name, value in parameters.items()]
    content: Json = {"EventType": kind, "Time": time, "EventParameters": listed}
    return {"Event": content | ({} if duration is None else {"EventDuration": duration})}


def step(name: str, time: float, value: float) -> Json:
    return {"Parameter": {"ParameterID": name, "Time": time, "ParameterValue": value}}


def curve(name: str, time: float, *points: tuple[float, float]) -> Json:
    listed = [{"Time": point_s, "ParameterValue": value} for point_s, value in points]
    return {"ParameterCurve": {"ParameterID": name, "Time": time, "ParameterCurveControlPoints": listed}}


def ahap(*entries: Json) -> Json:
    return {"Version": 1, "Metadata": {"Project": "test"}, "Pattern": list(entries)}


def haptic(amplitude: list[Json], frequency: list[tuple[float, float]], version: int = 1) -> Json:
    points = [{"time": time_s, "frequency": value} for time_s, value in frequency]
    envelopes = {"amplitude": amplitude, "frequency": points}
    signals = {"continuous": {"envelopes": envelopes}}
    return {"version": {"major": version, "minor": 0, "patch": 0}, "metadata": {"tags": []}, "signals": signals}


def point(time: float, amplitude: float, *emphasis: float) -> Json:
    """Return a point of an envelope of amplitude, and the amplitude and frequency of its emphasis, if any."""
    content = {"time": time, "amplitude": amplitude}
    return content | ({"emphasis": dict(zip(("amplitude", "frequency"), emphasis, strict=True))} if emphasis else {})


def haps(*melodies: list[Json], **keys: Any) -> Json:
    listed = [{"m_mute": 0, "m_gain": 0.5, "m_notes": notes} for notes in melodies]
    vibration = {"m_loop": 0, "m_gain": 1.0, "m_melodies": listed}
    return {"m_version": "5", "m_gain": 1.0, "m_vibration": vibration, **keys}


def note(start: float, length: float, gain: float, **modulations: list[tuple[float, float]]) -> Json:
    """Return a note, or a transient without modulations."""
    keyframes = {
        f"m_{name}Modulation": {"m_keyframes": [{"m_time": time_s, "m_value": value} for time_s, value in points]}
        for name, points in modulations.items()
    }
    return {"m_startingPoint": start, "m_length": length, "m_gain": gain, "m_hapticEffect": keyframes or {"m_type": 0}}


def hjif(kind: str, *effects: Json, library: Sequence[Json] = (), timescale: int = 1000, **keys: Any) -> Json:
    """Return an HJIF clip with one band; `keys`: of the band, the channel and the perception."""
    limits = {"lower_frequency_limit": 0, "upper_frequency_limit": 1000}
    band = {"band_type": kind, **limits, **keys, "effects": list(effects)}
    channel = {"id": 0, "gain": 1.0, **keys, "bands": [band]}
    perception = {"id": 0, "perception_modality": "Vibrotactile", **keys, "effect_library": list(library)}
    return {"version": "2023", "timescale": timescale, "perceptions": [perception | {"channels": [channel]}]}


def effect(position: int, *keyframes: tuple[int, float | None, float | None], **keys: Any) -> Json:
    """Return an effect with keyframes of position, amplitude and frequency, each of which may be missing."""
    names = ("relative_position", "amplitude_modulation", "frequency_modulation")
    listed = [{name: value for name, value in zip(names, each, strict=True) if value is not None} for each in keyframes]
    return {"effect_type": "Basis", "position": position, "keyframes": listed, **keys}


HUM = event("HapticContinuous", 0.1, 0.5, HapticIntensity=1, HapticSharpness=0.5)


@pytest.fixture
def loaded(tmp_path: Path) -> Callable[..., Recording]:
    """Return what writes a clip of a suffix, as JSON or as bytes, and loads it."""

    def load_clip(suffix: str, content: Json | bytes, **options: Any) -> Recording:
        path = tmp_path / f"clip{suffix}"
        path.write_bytes(content if isinstance(content, bytes) else json.dumps(content).encode())
        return load(path, **options)

    return load_clip


def course(recording: Recording, *times_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the amplitude of the first channel and its frequency in Hz, around each time."""
    rate_hz = recording.rate_hz
    analytic = hilbert(recording.samples[:, 0])
    places = np.rint(np.array(times_s) * rate_hz).astype(int)
    frequencies = np.diff(np.unwrap(np.angle(analytic))) * rate_hz / 2 / np.pi
    around = places[:, None] + np.arange(-20, 20)
    return np.abs(analytic)[around].mean(axis=1), frequencies[around].mean(axis=1)


def test_an_ahap_event_is_a_sine_of_its_intensity_and_sharpness(loaded: Callable[..., Recording]) -> None:
    recording = loaded(".ahap", ahap(event("HapticContinuous", 0.1, 0.5, HapticIntensity=0.8, HapticSharpness=0.2)))
    assert (recording.rate_hz, recording.unit, recording.drive, recording.channels) == (RATE_HZ, "full scale", True, 1)
    times_s = np.arange(4800) / RATE_HZ
    expected = 0.64 * np.sin(2 * np.pi * 112 * (times_s - 0.1)) * (times_s >= 0.1)
    np.testing.assert_allclose(recording.samples[:, 0], expected, atol=1e-9)


def test_an_ahap_transient_has_two_cycles(loaded: Callable[..., Recording]) -> None:
    recording = loaded(".ahap", ahap(event("HapticTransient", 0.25, HapticIntensity=1, HapticSharpness=1)))
    times_s = np.arange(len(recording.samples)) / RATE_HZ - 0.25
    assert recording.seconds == pytest.approx(0.25 + 2 / 300, abs=1 / RATE_HZ)
    np.testing.assert_allclose(recording.samples[:, 0], np.sin(2 * np.pi * 300 * times_s) * (times_s >= 0), atol=1e-9)


def test_ahap_parameters_change_events_from_their_time_on(loaded: Callable[..., Recording]) -> None:
    changes = [
        step("HapticIntensityControl", 0.2, 0.5),
        curve("HapticIntensityControl", 0.3, (0, 0.5), (0.2, 1)),
        step("HapticSharpnessControl", 0.3, 0.25),
        curve("HapticSharpnessControl", 0.4, (0, -2), (0.2, -2)),  # out of range: as if sharpness were 0
    ]
    recording = loaded(".ahap", ahap(HUM, *changes))
    amplitudes, frequencies_hz = course(recording, 0.15, 0.25, 0.35, 0.45, 0.55)
    np.testing.assert_allclose(amplitudes, np.square([1, 0.5, 0.625, 0.875, 1]), atol=0.02)
    np.testing.assert_allclose(frequencies_hz, [182.5, 182.5, 241.25, 65, 65], rtol=0.04)


def test_of_overlapping_ahap_curves_the_one_that_starts_last_counts(loaded: Callable[..., Recording]) -> None:
    first = curve("HapticIntensityControl", 0.1, (0, 0.2), (0.4, 1))
    second = curve("HapticIntensityControl", 0, (0.3, 0.8))  # its first point is at 0.3 s
    amplitudes, _ = course(loaded(".ahap", ahap(second, HUM, first)), 0.2, 0.4, 0.5)
    np.testing.assert_allclose(amplitudes, np.square([0.4, 0.8, 0.8]), atol=0.02)


def test_ahap_intensity_is_controlled_for_transients_too_and_sharpness_is_not(loaded: Callable[..., Recording]) -> None:
    tap = event("HapticTransient", 0.1, HapticIntensity=1, HapticSharpness=0)
    dimmed = [step("HapticIntensityControl", 0, 0.5), step("HapticSharpnessControl", 0, 1)]
    plain, changed = (loaded(".ahap", ahap(tap, *more)).samples for more in ([], dimmed))
    np.testing.assert_allclose(changed, plain / 4, atol=1e-12)


def test_ahap_of_people_and_programs_is_read(loaded: Callable[..., Recording]) -> None:
    text = json.dumps(ahap(HUM, event("HapticTransient", 0))).replace("}]", "}, ]").replace('"test"', '"a,] \\" ,}"')
    assert ", ]" in text
    edited = loaded(".ahap", b"\xef\xbb\xbf" + text.encode())
    assert edited.seconds == pytest.approx(0.6)
    named = json.dumps(ahap(HUM)).replace("EventDuration", "Duration")
    np.testing.assert_array_equal(loaded(".ahap", named.encode()).samples, loaded(".ahap", ahap(HUM)).samples)


def test_notes_name_the_constants_of_ahap_and_what_is_left_out(loaded: Callable[..., Recording]) -> None:
    hum = event("HapticContinuous", 0, 0.1, AttackTime=0.3, DecayTime=0, Sustained=1)
    endless = event("HapticContinuous", 0)
    notes = loaded(".ahap", ahap(hum, endless, event("AudioCustom", 0), step("AudioVolumeControl", 0, 1))).notes
    assert notes[:2] == ("rendered at 8000 Hz", "amplitude = intensity ^ 2; sharpness 0 to 1 = 65 to 300 Hz")
    assert notes[-1] == "left out: AttackTime, AudioCustom, AudioVolumeControl, HapticContinuous without EventDuration"


def test_a_haptic_clip_follows_its_envelopes(loaded: Callable[..., Recording]) -> None:
    amplitude = [point(5e-06, 0.2), point(0.2, 1), point(0.2, 0.3), point(0.6, 0.7)]  # with a step
    recording = loaded(".haptic", haptic(amplitude, [(0, 0), (0.3, 0.6)]))
    assert recording.drive and recording.seconds == pytest.approx(0.6)
    amplitudes, frequencies_hz = course(recording, 0.1, 0.15, 0.3, 0.4, 0.5)
    np.testing.assert_allclose(amplitudes, [0.6, 0.8, 0.4, 0.5, 0.6], atol=0.03)
    np.testing.assert_allclose(frequencies_hz, [66, 89, 158, 158, 158], rtol=0.04)
    notes = loaded(".haptic", haptic(amplitude, [])).notes
    assert notes[1] == "as on a generic PCM device: frequency 0 to 1 = 20 to 250 Hz"


def test_a_haptic_clip_without_frequencies_has_the_middle_one(loaded: Callable[..., Recording]) -> None:
    content = haptic([point(0, 1), point(0.5, 1)], [])
    samples = loaded(".haptic", content).samples[:, 0]
    np.testing.assert_allclose(samples, np.sin(2 * np.pi * 135 * np.arange(4000) / RATE_HZ), atol=1e-9)
    del content["signals"]["continuous"]["envelopes"]["frequency"]
    np.testing.assert_array_equal(loaded(".haptic", content).samples[:, 0], samples)


def test_an_emphasis_of_a_haptic_clip_ducks_the_rest(loaded: Callable[..., Recording]) -> None:
    plain, sine, square = (
        loaded(".haptic", haptic([point(0, 0.4), point(0.1, 0.4, *emphasis), point(0.3, 0.4)], [])).samples[:, 0]
        for emphasis in ((), (0.8, 0), (0.3, 1))
    )
    times_s = np.arange(2400) / RATE_HZ - 0.1
    during = (times_s > -1e-9) & (times_s < 0.027 - 1e-9)
    expected = np.where(during, plain / 2 + 0.8 * np.sin(2 * np.pi * 55 * times_s), plain)
    np.testing.assert_allclose(sine, expected, atol=1e-9)
    assert times_s[np.flatnonzero(square != plain)[[0, -1]]] == pytest.approx([0, 0.02], abs=2 / RATE_HZ)
    np.testing.assert_allclose(np.abs(square - plain / 2)[during & (times_s < 0.0199)], 0.3, atol=1e-9)


@pytest.mark.parametrize(
    ("base_signal", "quarters"),
    [
        ("Sine", (0, 1, 0, -1)),
        ("Square", (1, 1, -1, -1)),
        ("Triangle", (0, 1, 0, -1)),
        ("SawToothUp", (0, 0.5, -1, -0.5)),
        ("SawToothDown", (0, -0.5, 1, 0.5)),
    ],
)
def test_base_signals_of_hjif(base_signal: str, quarters: tuple[float, ...], loaded: Callable[..., Recording]) -> None:
    wave = effect(100, (0, 0.5, 100), (100, 0.5, 100), base_signal=base_signal)
    samples = loaded(".hjif", hjif("VectorialWave", wave)).samples[800::20, 0]
    np.testing.assert_allclose(samples, 0.5 * np.tile(quarters, 10), atol=1e-9)


def test_a_wave_of_hjif_follows_its_keyframes_at_any_timescale(loaded: Callable[..., Recording]) -> None:
    keyframes = [(0, 0.2, None), (200, 1.0, 60), (400, None, 160), (600, 0.6, None)]
    plain = loaded(".hjif", hjif("VectorialWave", effect(100, *keyframes)))
    amplitudes, frequencies_hz = course(plain, 0.2, 0.35, 0.4, 0.6)
    np.testing.assert_allclose(amplitudes, [0.6, 0.95, 0.9, 0.7], atol=0.02)
    np.testing.assert_allclose(frequencies_hz, [60, 85, 110, 160], rtol=0.03)
    fine = [(8 * position, amplitude, frequency) for position, amplitude, frequency in keyframes]
    scaled = loaded(".hjif", hjif("VectorialWave", effect(800, *fine), timescale=8000))
    np.testing.assert_allclose(scaled.samples, plain.samples, atol=1e-9)
    shifted = loaded(".hjif", hjif("VectorialWave", effect(0, (0, None, 100), (50, None, 100), phase=np.pi / 2)))
    np.testing.assert_allclose(shifted.samples[:, 0], np.cos(2 * np.pi * 100 * np.arange(400) / RATE_HZ), atol=1e-9)


@pytest.mark.parametrize(
    ("curve_type", "passed", "between"),
    [
        ("Linear", slice(None), 0.35),
        ("Cubic", slice(None), 0.35),
        ("Unknown", slice(None), 0.35),
        ("Akima", slice(None), None),
        ("Bezier", slice(None, None, 2), None),
        ("Bspline", slice(None, None, 4), None),
    ],
)
def test_curves_of_hjif_pass_their_points(
    curve_type: str, passed: slice, between: float | None, loaded: Callable[..., Recording]
) -> None:
    positions, amplitudes = [10, 50, 100, 160, 220], [0.0, 0.7, -0.4, 0.5, 0.1]
    keyframes = [(position, amplitude, None) for position, amplitude in zip(positions, amplitudes, strict=True)]
    content = hjif("Curve", effect(30, *keyframes), curve_type=curve_type)
    samples = loaded(".hjif", content).samples[:, 0]
    assert not np.any(samples[:320]) and len(samples) == 2000
    at_points = np.append(samples, 0.1)[[8 * (30 + position) for position in positions]]
    np.testing.assert_allclose(at_points[passed], amplitudes[passed], atol=1e-9)
    if between is not None:
        assert samples[8 * 60] == pytest.approx(between)
    assert np.abs(np.diff(samples)).max() < 0.02  # it has no step
    two = loaded(".hjif", hjif("Curve", effect(0, (0, 0, None), (40, 0.8, None)), curve_type=curve_type)).samples
    assert two[160, 0] == pytest.approx(0.4)


def test_references_of_hjif_play_the_library(loaded: Callable[..., Recording]) -> None:
    own = effect(7, (0, 0.8, 150), (60, 0, 150), id=3)
    content = hjif("VectorialWave", effect(20, id=3), effect(120, id=3), effect(200, id=9), library=[own])
    for each in content["perceptions"][0]["channels"][0]["bands"][0]["effects"]:
        each["effect_type"] = "Reference"
    recording = loaded(".hjif", content)
    plain = loaded(".hjif", hjif("VectorialWave", own | {"position": 20}, own | {"position": 120}))
    np.testing.assert_allclose(recording.samples, plain.samples, atol=1e-12)
    assert recording.notes[-1] == "left out: Reference without an effect"


def test_channels_of_hjif_are_scaled_and_transients_add_up(loaded: Callable[..., Recording]) -> None:
    tap = effect(10, (5, 0.5, 300))
    sine = np.sin(4 * np.pi * np.arange(176) / 176)
    plain = loaded(".hjif", hjif("Transient", tap, tap, gain=0.5, perception_unit_exponent=-1)).samples
    np.testing.assert_allclose(plain[120:, 0], 0.05 * sine, atol=1e-9)
    content = hjif("Transient", tap, gain=4, sample_count=12000, frequency_sampling=8000)
    content["perceptions"][0]["tracks"] = content["perceptions"][0].pop("channels")
    content["perceptions"] += hjif("Transient", tap, perception_modality="Stiffness")["perceptions"]
    content["perceptions"] += hjif("Transient", tap, perception_modality="Pressure")["perceptions"]
    recording = loaded(".hjif", content)
    assert (recording.channels, recording.seconds) == (2, 1.5)
    np.testing.assert_allclose(recording.samples[120:296, 0], np.clip(2 * sine, -1, 1), atol=1e-9)
    np.testing.assert_allclose(recording.samples[120:296, 1], 0.5 * sine, atol=1e-9)
    assert recording.notes[1:] == (
        "a transient = 2 cycles in 22 ms, whatever its frequency",
        "left out: Stiffness (over position)",
    )


@pytest.mark.parametrize("unit_ticks", [40, 128, 5000])
def test_hmpg_has_the_content_of_hjif(unit_ticks: int, loaded: Callable[..., Recording]) -> None:
    own = effect(0, (0, 0.8, 150), (60, 0, 120), id=3, base_signal="Triangle", phase=1.0)
    references = [{"effect_type": "Reference", "position": position, "id": 3} for position in (20, 300)]
    long = effect(100, (0, 0.2, None), (150, 1.0, 60), (170, None, 160), (300, 0.6, None), base_signal="Square")
    document = hjif("VectorialWave", *references, long, library=[own], gain=0.8)
    waves = document["perceptions"][0]
    curve = effect(30, (0, 0.1, None), (40, 0.7, None), (90, -0.4, None))
    waves["channels"] += hjif("Curve", curve, curve_type="Bezier")["perceptions"][0]["channels"]
    taps = hjif("Transient", effect(7, (5, 0.5, 300), (220, -0.9, 90)), perception_unit_exponent=-1)
    document["perceptions"] += taps["perceptions"]
    document["perceptions"] += hjif("Transient", perception_modality="Stiffness")["perceptions"]
    exact, coded = loaded(".hjif", document), loaded(".hmpg", hmpg(document, unit_ticks))
    assert coded.notes == exact.notes
    assert coded.samples.shape == exact.samples.shape == (len(exact.samples), 3)
    np.testing.assert_allclose(coded.samples, exact.samples, atol=1 / 255)


def test_a_wavelet_band_of_hmpg_is_rejected(loaded: Callable[..., Recording]) -> None:
    with pytest.raises(TextureError, match="no patent rights"):
        loaded(".hmpg", hmpg(hjif("WaveletWave", effect(0)), 128))


def test_hmpg_that_is_cut_off_is_rejected_or_ends_early(loaded: Callable[..., Recording]) -> None:
    whole = (EXAMPLES[0].parent / "saw.hmpg").read_bytes()
    longest = load(EXAMPLES[0].parent / "saw.hmpg").seconds
    for length in range(len(whole)):
        try:
            assert loaded(".hmpg", whole[:length]).seconds <= longest
        except TextureError as error:
            assert re.search(r"cut off|without a vibration", str(error))


EMPTY = hmpg(hjif("Transient"), 128)
HOSTILE_HMPG = {
    "more than 20000 effects": EMPTY + 7 * unit(1, 0, packet(5, [(33, 0), (16, 2900), *[(60, 0)] * 2900])),
    "(0, 9, 0), and none before it": EMPTY + unit(1, 0, packet(5, [(1, 0), (8, 0), (16, 9), (8, 0), (16, 1)])),
    "5 is the number of none of Transient": EMPTY + unit(0, 0, packet(4, [(40, 0), (3, 5), (48, 0)])),
    "begins before the clip": EMPTY + unit(1, 0, packet(5, [(33, 0), (16, 1), (18, 0), (25, -130), (17, 1), (40, 1)])),
    "it is cut off": EMPTY + unit(1, 0, packet(5, [(33, 0), (16, 1)])),
    "a composite effect": EMPTY + unit(0, 0, packet(6, [(8, 0), (16, 1), (64, 0), (16, 0), (16, 1)])),
    "a clip of 1.68e+04 s": EMPTY
    + unit(3, (1 << 24) - 1)
    + unit(1, 0, packet(5, [(33, 0), (16, 1), (18, 0), (25, 0), (17, 1), (40, 1 << 32)])),
}
"""HMPG files that cannot be rendered, each by words of its error."""


@pytest.mark.parametrize("words", HOSTILE_HMPG)
def test_hostile_hmpg_is_rejected(words: str, loaded: Callable[..., Recording]) -> None:
    with pytest.raises(TextureError, match=r"clip\.hmpg: ") as caught:
        loaded(".hmpg", HOSTILE_HMPG[words])
    assert words in str(caught.value)


def test_the_example_of_hmpg_is_that_of_hjif() -> None:
    folder = EXAMPLES[0].parent
    assert (folder / "saw.hmpg").read_bytes() == hmpg(json.loads((folder / "saw.hjif").read_text()), 128)


def test_a_wavelet_band_is_rejected_with_a_remedy(loaded: Callable[..., Recording]) -> None:
    with pytest.raises(TextureError, match=r"clip\.hjif: a wavelet band: no patent rights .*; load the WAV file"):
        loaded(".hjif", hjif("WaveletWave", {"position": 0, "wavelet_stream": "AAAA"}, block_length=128))


def test_references_cannot_multiply_without_end(loaded: Callable[..., Recording]) -> None:
    own = effect(0, *[(position, 1, None) for position in range(15_000)], id=1)
    content = hjif("Transient", *[{"effect_type": "Reference", "id": 1}] * 5000, library=[own])
    with pytest.raises(TextureError, match="more than 20000 parts"):
        loaded(".hjif", content)


def test_each_band_of_hjif_is_limited_by_itself(loaded: Callable[..., Recording]) -> None:
    flat = effect(0, (0, 0.8, None), (10, 0.8, None))
    document = hjif("Curve", flat, flat, curve_type="Linear")
    (channel,) = document["perceptions"][0]["channels"]
    down = hjif("Curve", effect(5, (0, -0.5, None), (5, -0.5, None)), curve_type="Linear")
    channel["bands"] += down["perceptions"][0]["channels"][0]["bands"]
    np.testing.assert_allclose(loaded(".hjif", document).samples[:, 0], [1.0] * 40 + [0.5] * 40, atol=1e-9)


def test_notes_name_what_is_odd_in_a_haptic_clip(loaded: Callable[..., Recording]) -> None:
    content = haptic([point(0, 0.5, 0.4, 0), point(1, 0)], [])
    content["version"]["minor"] = 3
    odd = ("an emphasis is weaker than the vibration at its time", "version 1.3 is read as 1.0")
    assert loaded(".haptic", content).notes[-2:] == odd
    assert len(loaded(".haptic", haptic([point(0, 0.5, 0.5, 0), point(1, 0)], [])).notes) == 3


def test_an_emphasis_ends_where_the_next_one_begins(loaded: Callable[..., Recording]) -> None:
    points = [point(0, 0), point(0.1, 0, 1, 0), point(0.105, 0, 0.5, 1), point(0.11, 0)]
    samples = loaded(".haptic", haptic(points, [])).samples[:, 0]
    assert len(samples) == 880
    np.testing.assert_allclose(samples[800:840], np.sin(2 * np.pi * 55 * np.arange(40) / RATE_HZ), atol=1e-9)
    assert set(samples[840:]) == {0.5, -0.5}


def test_notes_of_haps_play_with_all_gains(loaded: Callable[..., Recording]) -> None:
    hum = note(0.1, 0.4, 0.8, amplitude=[(0, 0), (0.2, 1), (0.4, 1)], frequency=[(0, 65), (0.2, 265)])
    content = haps([note(0.02, 0.022, 1)], [hum])
    recording = loaded(".haps", content)
    assert recording.drive and recording.seconds == pytest.approx(0.5)
    times_s = np.arange(0.02 * RATE_HZ, 0.042 * RATE_HZ) / RATE_HZ - 0.02
    np.testing.assert_allclose(recording.samples[160:336, 0], 0.5 * np.sin(4 * np.pi * times_s / 0.022), atol=1e-9)
    amplitudes, frequencies_hz = course(recording, 0.2, 0.4)
    np.testing.assert_allclose(amplitudes, [0.2, 0.4], atol=0.01)
    np.testing.assert_allclose(frequencies_hz, [165, 265], rtol=0.03)
    content["m_vibration"]["m_gain"], content["m_gain"] = 0.5, 0.5
    np.testing.assert_allclose(loaded(".haps", content).samples, recording.samples / 4, atol=1e-12)
    content["m_vibration"]["m_melodies"][1]["m_mute"] = 1
    assert loaded(".haps", content).seconds == pytest.approx(0.042, abs=1 / RATE_HZ)


def test_notes_name_what_is_left_out_of_haps(loaded: Callable[..., Recording]) -> None:
    content = haps([note(0, 0.1, 1, amplitude=[(0, 1)])], m_stiffness={"m_melodies": [{"m_notes": [{"any": 1}]}]})
    content["m_vibration"]["m_loop"] = 1
    modulation = content["m_vibration"]["m_melodies"][0]["m_notes"][0]["m_hapticEffect"]["m_amplitudeModulation"]
    modulation["m_keyframes"][0]["m_inSlope"] = 2
    recording = loaded(".haps", content)
    assert recording.notes[-1] == "left out: m_inSlope and m_outSlope, m_loop, m_stiffness"
    assert recording.notes[1].endswith("a note without frequencies has 182.5 Hz")
    np.testing.assert_allclose(course(recording, 0.05), [[0.5], [182.5]], rtol=0.03)


@pytest.mark.parametrize(
    ("suffix", "content", "words"),
    [
        (".haptic", haptic([point(0, 1), point(1, 1)], [], version=0), "version 0 of the format, and only 1 is known"),
        (
            ".haptic",
            {"version": {"major": 0}, "vij": 1},
            "version 0 of the format, and only 1 is known; open it in Meta",
        ),
        (".haptic", haptic([point(0, 1)], []), "length >= 2"),
        (".haptic", haptic([point(0, 1), point(-1, 1)], []), ">= 0.0"),
        (".haptic", haptic([point(1, 1), point(0.5, 1)], []), "the times of its amplitude fall"),
        (".haptic", haptic([point(0, 1), point(0, 1)], []), "without a vibration"),
        (".haptic", haptic([point(0, 1), point(1, 1.1)], []), "<= 1.0"),
        (
            ".haps",
            haps() | {"m_version": "4"},
            "version 4 of the format, and only 5 is known; open it in Haptic Composer",
        ),
        (".haps", haps(), "without a vibration"),
        (".haps", haps([note(-1, 1, 1)]), ">= 0.0"),
        (".haps", haps([note(0, 1, 1, amplitude=[(1, 1), (0, 1)])]), "the times of its amplitudes fall"),
        (".haps", haps([note(0, 1, -1)]), ">= 0.0"),
        (".hjif", hjif("Curve"), "without a vibration"),
        (".hjif", hjif("Music"), "Invalid enum value 'Music'"),
        (".hjif", hjif("Transient", effect(-1, (0, 1, 90))), ">= 0"),
        (".hjif", hjif("Transient", effect(0, (0, 2, 90))), "<= 1.0"),
        (".hjif", hjif("Curve", effect(0, (2, 1, None), (1, 1, None))), "the times of its keyframes fall"),
        (".hjif", hjif("Curve", effect(0, (2, 1, None)), timescale=0), ">= 1"),
        (".hjif", hjif("Curve", effect(700_000, (2, 1, None), (3, 1, None))), "a clip of 700 s with 1 parts"),
        (".hjif", {"perceptions": [{"channels": [{}] * 17}]}, "a clip of 17 channels; give one of at most 16"),
        (".hjif", {"perceptions": [{}] * 17}, "length <= 16"),
    ],
)
def test_other_clips_that_cannot_be_rendered(
    suffix: str, content: Json, words: str, loaded: Callable[..., Recording]
) -> None:
    with pytest.raises(TextureError, match=rf"clip\{suffix}: ") as caught:
        loaded(suffix, content)
    assert words in str(caught.value) and str(caught.value).count(f"clip{suffix}") == 1


def test_a_clip_is_rendered_at_your_rate_and_scaled_to_your_unit(loaded: Callable[..., Recording]) -> None:
    recording = loaded(".ahap", ahap(HUM), rate_hz=2800, unit="m/s^2", full_scale=3)
    assert (recording.rate_hz, recording.unit, recording.drive) == (2800, "m/s^2", False)
    assert len(recording.samples) == 1680 and recording.samples.max() == pytest.approx(3, rel=1e-3)
    with pytest.raises(TextureError, match=r"a clip, and 100 Hz; give 2000 to 200000 Hz"):
        loaded(".ahap", ahap(HUM), rate_hz=100)


def test_what_exceeds_full_scale_is_limited(loaded: Callable[..., Recording]) -> None:
    samples = loaded(".ahap", ahap(HUM, HUM)).samples
    assert samples.max() == 1 and np.mean(samples == 1) > 0.1


def encoded(*entries: Json) -> bytes:
    return json.dumps(ahap(*entries)).encode()


LONG_HUM = event("HapticContinuous", 0, 30)
HOSTILE_AHAP = {
    "invalid character": b'{"Pattern": [{"Event": {"EventType": "HapticTransient", "Time": NaN}}]}',
    "Number out of range": b'{"Pattern": [{"Event": {"EventType": "HapticTransient", "Time": 1e999}}]}',
    ">= 0.0": encoded(event("HapticTransient", -1)),
    "<= 600.0": encoded(event("HapticTransient", 1e6)),
    "recursion": b'{"Other": ' + b'{"a":' * 900_000,
    "truncated": encoded(HUM)[:-9],
    "longer than 5000000 bytes": b" " * 5_000_001,
    "length <= 20000": b'{"Pattern": [' + b",".join([b'{"Event":{"EventType":"HapticTransient"}}'] * 20_001) + b"]}",
    "of 3.93e+03 s together": encoded(*[LONG_HUM] * 131),
    "without a vibration": encoded(event("AudioCustom", 0)),
    "times of its HapticIntensityControl fall": encoded(HUM, curve("HapticIntensityControl", 0, (1, 0), (0, 1))),
    "length >= 1": encoded(HUM, curve("HapticIntensityControl", 0)),
    "missing required field `Pattern`": b"{}",
    "`object`": b"[]",
    "< 2.0": b'{"Version": 2, "Pattern": []}',
    "malformed": b"RIFF\x00\x01",
    "Input data was truncated": b"",
}
"""AHAP files that cannot be rendered, each by words of its error."""


@pytest.mark.parametrize("words", HOSTILE_AHAP)
def test_a_hostile_clip_is_rejected_in_little_memory(words: str, loaded: Callable[..., Recording]) -> None:
    content = HOSTILE_AHAP[words]
    tracemalloc.start()
    try:
        with pytest.raises(TextureError, match=r"clip\.ahap: ") as caught:
            loaded(".ahap", content)
        assert tracemalloc.get_traced_memory()[1] < 50_000_000
    finally:
        tracemalloc.stop()
    assert words in str(caught.value)


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.suffix)
@given(data=st.data())
def test_a_damaged_clip_is_rejected_or_rendered(
    example: Path, data: st.DataObject, tmp_path_factory: pytest.TempPathFactory
) -> None:
    whole = bytearray(example.read_bytes())
    for _ in range(data.draw(st.integers(1, 3))):
        whole[data.draw(st.integers(0, len(whole) - 1))] = data.draw(st.sampled_from(b'019-e.,:[]{}" nN\x00\xff'))
    path = tmp_path_factory.mktemp("clips") / example.name
    path.write_bytes(whole)
    try:
        recording = load(path)
    except TextureError as error:
        assert str(path) in str(error)
    else:
        assert recording.seconds <= synthesis.MAX_SECONDS and np.abs(recording.samples).max() <= 1


def test_every_reader_is_listed() -> None:
    assert set(clips.SUFFIXES) == {path.suffix for path in EXAMPLES}
