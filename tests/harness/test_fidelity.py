"""Fidelity: the skin compared with the sent signal, by the model and by a sensor with its own clock and gain."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from tests.harness.test_response import bench
from vibrocast.harness import fidelity
from vibrocast.host.devices import session_with
from vibrocast.host.playback import displacement_above_20_hz
from vibrocast.output.actuator import PIEZO_STACK
from vibrocast.textures import GENERATORS, Recording


def figures_of(measured: fidelity.Fidelity) -> dict[str, float | None]:
    """Return the figures by their keys."""
    return {value.key: value.value for value in measured.figures()}


@pytest.mark.parametrize("unit", ["um", "m/s^2"])
def test_a_sensor_of_its_own_clock_sees_what_the_model_says(unit: str) -> None:
    texture = GENERATORS["rough"](seconds=2.0)
    controller, recorder = bench(PIEZO_STACK, PIEZO_STACK, unit, drift_ppm=60.0, noise_db=-60.0)
    measure = partial(fidelity.measure_fidelity, session_with(controller, "memory"), texture)
    modelled, recorded = measure(), measure(recorder=recorder, sensor_name="it")
    known, seen = figures_of(modelled), figures_of(recorded)
    assert known["as_decoded"] is known["as_computed"] is seen["as_computed"] is True
    assert known["playing_snr_db"] is not None and known["playing_snr_db"] > 25
    assert seen["playing_snr_db"] == pytest.approx(known["playing_snr_db"], abs=2.0)
    assert seen["st_sim"] == pytest.approx(known["st_sim"], abs=0.02)
    assert seen["gain"] == pytest.approx(known["gain"], rel=0.02)
    assert recorded.drift_ppm == pytest.approx(60.0, abs=15.0)
    assert (modelled.source, recorded.source) == ("the DAC's codes and a model", "it")


def test_an_actuator_that_is_not_as_believed_is_seen() -> None:
    texture = GENERATORS["rough"](seconds=2.0)
    real = replace(PIEZO_STACK, corner_hz=120.0)
    controller, recorder = bench(PIEZO_STACK, real, "um", noise_db=-60.0)
    measured = fidelity.measure_fidelity(
        session_with(controller, "memory"), texture, recorder=recorder, sensor_name="it"
    )
    figures = figures_of(measured)
    assert figures["as_computed"] is True
    assert figures["playing_snr_db"] is not None and figures["playing_snr_db"] < 20
    assert np.argmax(measured.spectrum.residual_db) > 0


@pytest.mark.parametrize(("unit", "offset", "drift"), [("m/s^2", 9.81, 3.0), ("um", 1000.0, 50.0)])
def test_gravity_distance_and_drift_of_a_sensor_leave_no_step(unit: str, offset: float, drift: float) -> None:
    noise = np.random.default_rng(0).standard_normal((8000, 1))
    moved = noise + offset + drift * np.linspace(0, 1, 8000)[:, None]
    flat, other = (
        displacement_above_20_hz(Recording(samples, 10_000, unit, "sensor"), 2800) for samples in (noise, moved)
    )
    np.testing.assert_allclose(other, flat, atol=1e-3 * float(np.std(flat)))
