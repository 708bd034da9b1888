"""The frequency response by a sweep: an unknown actuator's parameters from a noisy sensor, and what they do."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest

from tests.conftest import linked
from vibrocast.harness import response
from vibrocast.harness.response import Samples
from vibrocast.harness.sensors import Recorder
from vibrocast.host.controller import Controller
from vibrocast.host.playback import AlignmentError
from vibrocast.output.actuator import (
    LRA,
    PIEZO_STACK,
    VOICE_COIL,
    Actuator,
    Codes,
)
from vibrocast.simulated_device.controller import Settings
from vibrocast.textures import Recording

OVERSAMPLING = 4
SWEEP_S = 4.0
DRIFT_PPM = 40.0  # of the sensor's clock, whose file does not know it
NOISE_DB = -20.0  # of the sensor, relative to its recording of the sweep


def bench(
    believed: Actuator, real: Actuator, unit: str, drift_ppm: float = 0.0, noise_db: float = NOISE_DB
) -> tuple[Controller, Recorder]:
    """Return a controller that believes in one actuator and drives another, and a noisy sensor on that."""
    codes: list[Codes] = []
    _, controller = linked(Settings(actuator=believed), on_dac=codes.append)
    rate_hz = OVERSAMPLING * real.dac_rate_hz

    @contextmanager
    def record(seconds: float) -> Iterator[Callable[[], Recording]]:
        codes.clear()

        def finish() -> Recording:
            before = np.zeros((real.dac_rate_hz // 3, 1), np.int16)
            skin = real.displacement_um(np.concatenate((before, *codes, before)), OVERSAMPLING)[:, 0]
            if unit == "m/s^2":
                skin = 1e-6 * np.gradient(np.gradient(skin, 1 / rate_hz), 1 / rate_hz)
            noise = np.random.default_rng(3).standard_normal(len(skin))
            noise *= 10 ** (noise_db / 20) * np.sqrt(np.mean(np.square(skin)))
            return Recording((skin + noise)[:, None], rate_hz / (1 + drift_ppm / 1e6), unit, "sensor")

        yield finish

    return controller, record


@pytest.mark.slow
@pytest.mark.parametrize(
    ("believed", "real", "unit"),
    [
        (PIEZO_STACK, replace(PIEZO_STACK, corner_hz=212.0, stroke_um=93.0), "um"),
        (LRA, replace(LRA, corner_hz=161.0, quality=11.3, stroke_um=170.0), "m/s^2"),
        (VOICE_COIL, replace(VOICE_COIL, corner_hz=74.0, quality=4.1), "um"),
    ],
    ids=lambda value: value.name if isinstance(value, Actuator) else value,
)
def test_an_unknown_actuator_is_recovered_from_a_noisy_sensor(believed: Actuator, real: Actuator, unit: str) -> None:
    controller, recorder = bench(believed, real, unit, DRIFT_PPM)
    measured = response.measure_response(controller, believed, recorder=recorder, seconds=SWEEP_S)
    fit = measured.fit
    assert fit.corner_hz == pytest.approx(real.corner_hz, rel=0.02)
    assert fit.stroke_um == pytest.approx(real.stroke_um, rel=0.02)
    if real.quality is None:
        assert fit.quality is None
    else:
        assert fit.quality == pytest.approx(real.quality, rel=0.02)
    assert fit.drift_ppm == pytest.approx(DRIFT_PPM, abs=10.0)
    assert 0 < fit.corner_error_hz < 0.02 * real.corner_hz


@pytest.mark.parametrize(("corner_hz", "quality"), [(162.6, None), (700.0, 3.0), (800.0, 15.0)])
@pytest.mark.filterwarnings("error")
def test_a_fit_of_the_wrong_kind_disturbs_nothing(corner_hz: float, quality: float | None) -> None:
    """A low-pass hardly determines Q, and a resonance at the end of the band no low-pass's corner."""
    real = replace(VOICE_COIL, corner_hz=corner_hz, quality=quality)
    time_s = np.arange(round(SWEEP_S * 8000)) / 8000
    octaves = np.log(1000.0 / response.MIN_HZ)
    phase = 2 * np.pi * response.MIN_HZ * SWEEP_S / octaves * (np.exp(octaves * time_s / SWEEP_S) - 1)
    fade = np.clip(np.minimum(time_s, SWEEP_S - time_s) / 0.02, 0.0, 1.0)
    given = np.round(0.1 * fade * np.sin(phase) * real.full_scale).astype(np.int16)[:, None]
    skin = Recording(real.displacement_um(given, OVERSAMPLING), OVERSAMPLING * 8000.0, "um", "model")
    fit = response.fit_actuator(response.Sweep(given[:, 0] / real.full_scale, 8000, SWEEP_S, 1000.0, skin))
    assert fit.corner_hz == pytest.approx(corner_hz, rel=0.01) and (fit.quality is None) == (quality is None)
    assert np.all(np.isfinite([fit.corner_error_hz, fit.stroke_error_um, fit.quality_error or 0.0]))
    assert fit.corner_error_hz < 0.01 * corner_hz


def test_a_missing_sensor_is_reported() -> None:
    controller, _ = bench(PIEZO_STACK, PIEZO_STACK, "um")

    @contextmanager
    def silent(seconds: float) -> Iterator[Callable[[], Recording]]:
        noise = np.random.default_rng(4).standard_normal((round(seconds * 8000), 1))
        yield lambda: Recording(noise, 8000.0, "um", "sensor")

    with pytest.raises(AlignmentError, match="check the sensor"):
        response.measure_response(controller, PIEZO_STACK, recorder=silent, seconds=SWEEP_S)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda samples, rate_hz: samples[round(0.38 * rate_hz) :], "no silence before the sweep"),
        (lambda samples, rate_hz: samples[: -round(0.36 * rate_hz)], "no silence after the sweep"),
        (lambda samples, rate_hz: np.clip(samples, -2.0, 2.0), "% of the recorded sweep unexplained"),
    ],
    ids=["begins late", "ends early", "hits a stop"],
)
def test_a_recording_that_does_not_show_the_actuator_is_rejected(
    spoil: Callable[[Samples, float], Samples], message: str
) -> None:
    controller, recorder = bench(PIEZO_STACK, PIEZO_STACK, "um")

    @contextmanager
    def spoiled(seconds: float) -> Iterator[Callable[[], Recording]]:
        with recorder(seconds) as finish:

            def finish_spoiled() -> Recording:
                whole = finish()
                return replace(whole, samples=spoil(whole.samples, whole.rate_hz))

            yield finish_spoiled

    with pytest.raises(AlignmentError, match=message):
        response.measure_response(controller, PIEZO_STACK, recorder=spoiled, seconds=SWEEP_S)


def test_without_a_sensor_the_model_is_found_again() -> None:
    controller, _ = bench(LRA, LRA, "um")
    measured = response.measure_response(controller, LRA, seconds=SWEEP_S)
    assert measured.source == "the model itself"
    assert measured.fit.corner_hz == pytest.approx(LRA.corner_hz, rel=1e-3)
    assert measured.fit.quality == pytest.approx(LRA.quality, rel=1e-2)
