"""Tests of haptic clips: what each format describes becomes that signal, and no file does harm."""

import json
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import hilbert

from vibrocast.textures import Recording, TextureError, clips, dataset, load
from vibrocast.textures.clips import synthesis

RATE_HZ = 8000
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
    notes = loaded(".ahap", ahap(hum, event("AudioCustom", 0), step("AudioVolumeControl", 0, 1))).notes
    assert notes[:2] == ("rendered at 8000 Hz", "amplitude = intensity ^ 2; sharpness 0 to 1 = 65 to 300 Hz")
    assert notes[-1] == "left out: AttackTime, AudioCustom, AudioVolumeControl"


def test_a_clip_is_rendered_at_your_rate_and_scaled_to_your_unit(loaded: Callable[..., Recording]) -> None:
    recording = loaded(".ahap", ahap(HUM), rate_hz=2800, unit="m/s^2", full_scale=3)
    assert (recording.rate_hz, recording.unit, recording.drive) == (2800, "m/s^2", False)
    assert len(recording.samples) == 1680 and recording.samples.max() == pytest.approx(3, rel=1e-3)
    with pytest.raises(TextureError, match=r"a clip, and 100 Hz; give 2000 to 200000 Hz"):
        loaded(".ahap", ahap(HUM), rate_hz=100)


def test_what_exceeds_full_scale_is_limited(loaded: Callable[..., Recording]) -> None:
    samples = loaded(".ahap", ahap(HUM, HUM)).samples
    assert samples.max() == 1 and np.mean(samples == 1) > 0.1


def test_a_folder_of_clips_is_a_data_set(tmp_path: Path) -> None:
    (tmp_path / "a.ahap").write_text(json.dumps(ahap(HUM)))
    (entry,) = dataset.entries(tmp_path)
    assert entry.path == tmp_path / "a.ahap"


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


@given(data=st.data())
def test_a_damaged_clip_is_rejected_or_rendered(data: st.DataObject, tmp_path_factory: pytest.TempPathFactory) -> None:
    whole = bytearray(json.dumps(ahap(HUM, curve("HapticIntensityControl", 0, (0, 1), (0.1, 0)))).encode())
    for _ in range(data.draw(st.integers(1, 3))):
        whole[data.draw(st.integers(0, len(whole) - 1))] = data.draw(st.sampled_from(b'019-e.,:[]{}" nN'))
    path = tmp_path_factory.mktemp("clips") / "clip.ahap"
    path.write_bytes(whole)
    try:
        recording = load(path)
    except TextureError as error:
        assert str(path) in str(error)
    else:
        assert recording.seconds <= synthesis.MAX_SECONDS and np.abs(recording.samples).max() <= 1


def test_every_reader_is_listed() -> None:
    assert set(clips.SUFFIXES) == {".ahap"}
