"""Tests of textures written as clips: what the clip keeps, and what is told about the rest."""

import json
from pathlib import Path

import numpy as np
import pytest

from vibrocast.codec import clip_export
from vibrocast.codec.clip_export import ClipExport
from vibrocast.textures import Recording, TextureError, clips, load

RATE_HZ = 4000


def sine(
    frequency_hz: float, amplitude: float = 1.0, seconds: float = 2.0, unit: str = "m/s^2", depth: float = 0.0
) -> Recording:
    """Return a sine, whose amplitude swings once a second by a part of it."""
    times_s = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    swing = 1 + depth * np.sin(2 * np.pi * times_s)
    samples = amplitude * swing * np.sin(2 * np.pi * frequency_hz * times_s)
    return Recording(samples[:, None], RATE_HZ, unit, "sine")


def exported(recording: Recording, path: Path) -> tuple[ClipExport, Recording]:
    """Return what is told of a clip, and the clip rendered."""
    return clip_export.export(path, recording), load(path)


def near(recording: Recording, time_s: float) -> tuple[float, float]:
    """Return the amplitude, and the frequency in Hz, of a tenth of a second."""
    samples = recording.samples[round(time_s * recording.rate_hz) :][: round(recording.rate_hz / 10), 0]
    spectrum = np.abs(np.fft.rfft(samples * np.hanning(len(samples)), 1 << 16))
    return float(np.sqrt(2 * np.mean(samples**2))), float(np.argmax(spectrum)) * recording.rate_hz / (1 << 16)


@pytest.mark.parametrize("suffix", clips.WRITERS)
def test_a_clip_keeps_the_course_of_amplitude_and_frequency(suffix: str, tmp_path: Path) -> None:
    export, clip = exported(sine(150, 3, depth=0.5), tmp_path / f"clip{suffix}")
    assert clip.seconds == pytest.approx(2, abs=1e-3)
    assert export.full_scale == pytest.approx(4.5, rel=0.02) and export.limited_energy == 0
    for time_s, amplitude in ((0.2, 4.5), (0.7, 1.5), (1.2, 4.5)):
        found, frequency_hz = near(clip, time_s)
        assert found * export.full_scale == pytest.approx(amplitude, rel=0.1)
        assert frequency_hz == pytest.approx(150, abs=2)
    assert export.quality.third_octave_distance_db is not None and export.quality.third_octave_distance_db < 3


@pytest.mark.parametrize("suffix", clips.WRITERS)
def test_frequencies_that_a_format_lacks_are_told(suffix: str, tmp_path: Path) -> None:
    export, clip = exported(sine(400), tmp_path / f"clip{suffix}")
    assert export.limited_energy == pytest.approx(1, abs=0.01)
    assert near(clip, 1)[1] == pytest.approx(clips.WRITERS[suffix].range_hz[1], abs=2)


def test_full_scale_is_kept(tmp_path: Path) -> None:
    for amplitude, expected in ((0.5, 0.5), (1.5, 1.0)):
        export, clip = exported(sine(150, amplitude, unit="full scale"), tmp_path / "clip.ahap")
        assert export.full_scale == 1 and near(clip, 1)[0] == pytest.approx(expected, rel=0.02)


def test_a_long_ahap_clip_has_several_events_and_short_curves(tmp_path: Path) -> None:
    _, clip = exported(sine(150, seconds=32), tmp_path / "clip.ahap")
    assert clip.seconds == pytest.approx(32, abs=1e-3) and near(clip, 31)[0] == pytest.approx(1, rel=0.02)
    pattern = json.loads((tmp_path / "clip.ahap").read_text())["Pattern"]
    assert [round(entry["Event"]["EventDuration"], 3) for entry in pattern if "Event" in entry] == [30, 2]
    curves = [entry["ParameterCurve"]["ParameterCurveControlPoints"] for entry in pattern if "ParameterCurve" in entry]
    assert max(map(len, curves)) == 16


def test_what_no_clip_can_be_is_rejected(tmp_path: Path) -> None:
    with pytest.raises(TextureError, match="2 channels, and a clip has one"):
        clip_export.export(tmp_path / "a.ahap", Recording(np.ones((90, 2)), RATE_HZ, "um", "two"))
    with pytest.raises(TextureError, match="silent"):
        clip_export.export(tmp_path / "a.ahap", Recording(np.zeros((90, 1)), RATE_HZ, "um", "none"))


def test_a_shortest_recording_becomes_a_clip(tmp_path: Path) -> None:
    export, clip = exported(Recording(np.ones((2, 1)), RATE_HZ, "um", "short"), tmp_path / "a.haptic")
    assert len(clip.samples) >= 1 and export.full_scale > 0
