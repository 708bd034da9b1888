"""Measures the frequency response from drive to displacement by a sweep, and fits the actuator's parameters to it."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vibrocast import codec, textures
from vibrocast.harness.sensors import Recorder, recorded
from vibrocast.host import player
from vibrocast.host.controller import Controller, ControllerError
from vibrocast.host.playback import AlignmentError
from vibrocast.output.actuator import Actuator, analog_response
from vibrocast.textures import Recording

Samples = NDArray[np.float64]
Spectrum = NDArray[np.complex128]

MIN_HZ, MAX_HZ = 10.0, 1000.0
# Of full drive: below every limit of the actuators that ship, and below clipping where a resonance is compensated.
AMPLITUDE = 0.1
SWEEP_S = 8.0

_FADE_S = 0.02
_MAX_RATE_HZ = 8000
# Steps relative to the RMS value: so fine that the codec's noise is 40 dB below the sweep. The DAC's codes, from which
# the response is computed, hold that noise too.
_STEP = 0.02
_CURVE_POINTS_PER_OCTAVE = 12
# Of the model's displacement, so that the images above the DAC's rate do not fold into the band.
_OVERSAMPLING = 16
_MIN_EXPLAINED = 0.05  # of the recorded power in the sweep's band
MAX_UNEXPLAINED = 0.01
"""Of that power. An actuator that hits a stop, or a recording with gaps, leaves more, and its parameters are wrong."""
_MIN_SILENCE_S = 0.02
_CONFIDENCE = 1.96  # standard errors of a 95 % interval


@dataclass(frozen=True)
class Curve:
    """A response at `frequencies_hz`: gain in dB re 1 um at full drive, phase without the delay, coherence 0 to 1."""

    frequencies_hz: tuple[float, ...]
    gain_db: tuple[float, ...]
    phase_degrees: tuple[float, ...]
    coherence: tuple[float, ...]


@dataclass(frozen=True)
class Fit:
    """The actuator's parameters that explain a sweep best, each with the half width of its 95 % interval.

    `quality` is None for a first-order low-pass, chosen where a resonance explains no more (Schwarz's criterion).
    `delay_ms`: of the recording. `drift_ppm`: of the recorder's clock. `unexplained`: part of the recorded power.
    """

    corner_hz: float
    corner_error_hz: float
    quality: float | None
    quality_error: float | None
    stroke_um: float
    stroke_error_um: float
    delay_ms: float
    drift_ppm: float
    unexplained: float


@dataclass(frozen=True)
class Response:
    """The result of a sweep. `source`: how the displacement is known. `actuator`: the model with the fitted values."""

    source: str
    curve: Curve
    fit: Fit
    actuator: Actuator


def measure_response(
    controller: Controller,
    actuator: Actuator,
    *,
    recorder: Recorder | None = None,
    sensor_name: str = "",
    seconds: float = SWEEP_S,
    progress: Callable[[float], None] | None = None,
) -> Response:
    """Play a sweep without compensation and fit the actuator's parameters. `actuator`: the model, for DAC and limits.

    `recorder`: the sensor on the first channel; None = the model itself, which shows that all is in order. Raises
    AlignmentError where the recording holds no whole sweep, or the fit does not explain it, SensorError,
    ControllerError and TransportError.
    """
    sweep = play_sweep(controller, actuator, False, recorder, seconds, progress)
    fit = fit_actuator(sweep)
    if recorder is not None:
        _check_silence(sweep, fit)
    if fit.unexplained > MAX_UNEXPLAINED:
        raise AlignmentError(
            f"the fit leaves {100 * fit.unexplained:.1f} % of the recorded sweep unexplained, at most "
            f"{100 * MAX_UNEXPLAINED:g} % is credible; check that the actuator moves freely, and the sensor for noise "
            "and gaps"
        )
    return Response(
        sensor_name or "the model itself",
        curve(sweep, fit.delay_ms, fit.drift_ppm),
        fit,
        replace(
            actuator,
            name=f"{actuator.name.removesuffix(' measured')} measured",
            corner_hz=fit.corner_hz,
            quality=fit.quality,
            stroke_um=fit.stroke_um,
        ),
    )


@dataclass(frozen=True)
class Sweep:
    """A sweep that was played: what went in, (n,) at `rate_hz`, relative to full scale, and what was recorded of it.

    `compensated`: the input is the decoded signal, otherwise the DAC's codes. `seconds` and `highest_hz` are the
    sweep's. `recording`: one channel, m/s^2 or um.
    """

    given: Samples
    rate_hz: int
    seconds: float
    highest_hz: float
    recording: Recording


def _check_silence(sweep: Sweep, fit: Fit) -> None:
    """Raise AlignmentError where the recording does not begin before the sweep, or does not end after it."""
    before_s = fit.delay_ms / 1e3
    after_s = sweep.recording.seconds - before_s - sweep.seconds
    for silence_s, place, action in ((before_s, "before", "starts"), (after_s, "after", "ends")):
        if silence_s < _MIN_SILENCE_S:
            raise AlignmentError(
                f"the recording holds no silence {place} the sweep ({1e3 * silence_s:.0f} ms), so a part may be "
                f"missing; check when the sensor's program {action}, and that this machine is not busy"
            )


def play_sweep(
    controller: Controller,
    actuator: Actuator,
    compensation: bool,
    recorder: Recorder | None = None,
    seconds: float = SWEEP_S,
    progress: Callable[[float], None] | None = None,
) -> Sweep:
    """Play an exponential sweep (Farina 2000) from MIN_HZ up, and record it. Raises as `measure_response`."""
    limits = controller.description.limits
    rate_hz = min(actuator.dac_rate_hz, limits.max_rate_hz, _MAX_RATE_HZ)
    highest_hz = min(MAX_HZ, 0.4 * rate_hz)
    time_s = np.arange(round(seconds * rate_hz)) / rate_hz
    phase = 2 * np.pi * MIN_HZ * seconds / np.log(highest_hz / MIN_HZ)
    chirp = AMPLITUDE * np.sin(phase * (np.exp(time_s / seconds * np.log(highest_hz / MIN_HZ)) - 1))
    chirp *= np.clip(np.minimum(time_s, seconds - time_s) / _FADE_S, 0.0, 1.0)
    stream = codec.encode(chirp[:, None], rate_hz, {"step": _STEP}, live=True)
    with recorded(recorder, controller, seconds) as finish:
        settings = player.PlaybackSettings(
            compensation=compensation,
            capture=True,
            progress=progress and (lambda now: progress(now.position_s / seconds)),
        )
        played = player.play(controller, stream, settings)
        if played.underruns or played.lost_packets or played.dac_codes is None or played.decoded is None:
            raise ControllerError("the sweep was interrupted; use a machine that is less busy, or a shorter cable")
        if finish is None:
            displacement_um = actuator.displacement_um(played.dac_codes[:, :1], _OVERSAMPLING)
            recording = Recording(displacement_um, _OVERSAMPLING * actuator.dac_rate_hz, "um", "model")
        else:
            recording = finish()
    given = played.dac_codes[:, 0] / actuator.full_scale
    if compensation:
        given = played.decoded[:, 0] / 32768 * stream.header.gains[0]
    return Sweep(given, rate_hz if compensation else actuator.dac_rate_hz, seconds, highest_hz, recording)


def fit_actuator(sweep: Sweep) -> Fit:
    """Fit a first-order low-pass and a resonance to a sweep, and return the better one. Raises AlignmentError.

    Output error: the least squared difference between the spectra of the recording and of the model's output, over the
    sweep's band. If the sensor's noise is white, these are the most likely parameters (Ljung, System Identification,
    2nd ed., section 7.4). The intervals are those of its linearisation there.
    """
    spectra = _Spectra(sweep)
    fits = [_least_squares(spectra, resonant) for resonant in (False, True)]
    # Schwarz's criterion (1978): n log(residual) + parameters log(n), the lower the better.
    equations = 2 * len(spectra.frequencies_hz)
    scores = [
        equations * np.log(fit.unexplained) + parameters * np.log(equations)
        for fit, parameters in zip(fits, (4, 5), strict=True)
    ]
    return fits[int(np.argmin(scores))]


def curve(sweep: Sweep, delay_ms: float | None = None, drift_ppm: float = 0.0) -> Curve:
    """Return the response of a sweep in twelfths of an octave, without its delay and the drift of the recorder's clock.

    A delay that is not given is where input and recording correlate best. Cross-spectrum over the input's power, summed
    over each band, and the coherence (Bendat and Piersol, Random Data, 4th ed., section 6.1).
    """
    spectra = _Spectra(sweep)
    delay_s = spectra.delay_s(spectra.correlation(spectra.given)) if delay_ms is None else delay_ms / 1e3
    given = spectra.given * spectra.late(delay_s, drift_ppm / 1e6)
    octaves = np.log2(spectra.frequencies_hz[-1] / spectra.frequencies_hz[0])
    edges_hz = np.geomspace(
        spectra.frequencies_hz[0], spectra.frequencies_hz[-1], round(octaves * _CURVE_POINTS_PER_OCTAVE) + 1
    )
    first = np.unique(np.searchsorted(spectra.frequencies_hz, edges_hz[:-1]))
    cross = np.add.reduceat(spectra.recorded * np.conj(given), first)
    power, recorded_power = (np.add.reduceat(np.square(np.abs(each)), first) for each in (given, spectra.recorded))
    count = np.diff(np.append(first, len(spectra.frequencies_hz)))
    return Curve(
        frequencies_hz=tuple((np.add.reduceat(spectra.frequencies_hz, first) / count).tolist()),
        gain_db=tuple((20 * np.log10(np.abs(cross) / power)).tolist()),
        phase_degrees=tuple(np.degrees(np.angle(cross)).tolist()),
        coherence=tuple((np.square(np.abs(cross)) / (power * recorded_power)).tolist()),
    )


class _Spectra:
    """Both ends of a sweep at the same frequencies, over its band: what went in, held by the DAC, and displacement."""

    def __init__(self, sweep: Sweep) -> None:
        recording = textures.resample(sweep.recording, sweep.rate_hz)
        output = recording.samples[:, 0] - np.mean(recording.samples[:, 0])
        self.rate_hz = sweep.rate_hz
        self.samples = max(len(output), len(sweep.given))
        frequencies_hz = np.fft.rfftfreq(self.samples, 1 / self.rate_hz)
        # A little inside the sweep, whose spectrum falls off at both ends.
        band = (frequencies_hz >= 1.2 * MIN_HZ) & (frequencies_hz <= sweep.highest_hz / 1.05)
        self._first = int(np.argmax(band))
        f = self.frequencies_hz = np.asarray(frequencies_hz[band], np.float64)
        period = f / self.rate_hz
        held = np.sinc(period) * np.exp(-1j * np.pi * period)
        self.given = np.fft.rfft(sweep.given, self.samples)[band] * held
        self.recorded = np.fft.rfft(output, self.samples)[band]
        if recording.unit == "m/s^2":
            self.given = self.given * (-np.square(2 * np.pi * f) * 1e-6)
        self._sweep_s = sweep.seconds * np.log(f / MIN_HZ) / np.log(sweep.highest_hz / MIN_HZ)

    def late(self, delay_s: float, drift: float) -> Spectrum:
        """Return the factor of a delay that grows with the time at which the sweep passes each frequency."""
        return np.asarray(np.exp(-2j * np.pi * self.frequencies_hz * (delay_s + drift * self._sweep_s)), np.complex128)

    def correlation(self, expected: Spectrum) -> Samples:
        """Return the cross-correlation with the recording at every delay, in samples."""
        whole = np.zeros(self.samples // 2 + 1, np.complex128)
        whole[self._first : self._first + len(expected)] = self.recorded * np.conj(expected)
        return np.asarray(np.fft.irfft(whole, self.samples))

    def delay_s(self, correlation: Samples) -> float:
        """Return the delay, also a negative one, at which a cross-correlation is strongest."""
        delay = int(np.argmax(np.abs(correlation)))
        return (delay if delay < self.samples / 2 else delay - self.samples) / self.rate_hz


def _least_squares(spectra: _Spectra, resonant: bool) -> Fit:
    """Return the best fit of one kind; begins where a grid of models correlates best with the recording."""
    from scipy.optimize import least_squares

    best = (0.0, 0.0, 1.0, 1.0, 0.0)
    for corner_hz in np.geomspace(2 * MIN_HZ, spectra.frequencies_hz[-1], 24):
        for quality in (0.7, 3.0, 10.0, 30.0) if resonant else (None,):
            expected = spectra.given * analog_response(spectra.frequencies_hz, corner_hz, quality)
            correlation = spectra.correlation(expected)
            delay_s = spectra.delay_s(correlation)
            power = float(np.sum(np.square(np.abs(expected))))
            gain = float(correlation[round(delay_s * spectra.rate_hz)]) * spectra.samples / 2 / power
            best = max(best, (gain**2 * power, gain, float(corner_hz), quality or 1.0, delay_s))
    explained, gain, corner_hz, start_quality, delay_s = best
    recorded_power = float(np.sum(np.square(np.abs(spectra.recorded))))
    if explained < _MIN_EXPLAINED * recorded_power:
        raise AlignmentError("the recording does not contain the sweep; check the sensor and its sensitivity")
    scale = np.sqrt(recorded_power)

    def residual(parameters: Samples) -> Samples:
        log_gain, log_corner, late_ms, drift_ppm, *log_quality = parameters
        # The controller's clock counts, as for the sweep; the sensor's is off by the drift.
        frequencies_hz = spectra.frequencies_hz * (1 + drift_ppm / 1e6)
        shape = analog_response(frequencies_hz, np.exp(log_corner), np.exp(log_quality[0]) if resonant else None)
        late = spectra.late(delay_s + late_ms / 1e3, drift_ppm / 1e6)
        difference = (np.sign(gain) * np.exp(log_gain) * shape * late * spectra.given - spectra.recorded) / scale
        return np.concatenate((difference.real, difference.imag))

    start = [np.log(abs(gain)), np.log(corner_hz), 0.0, 0.0] + [np.log(start_quality)] * resonant
    solution = least_squares(residual, start, x_scale="jac")
    unexplained = 2 * float(solution.cost)
    variance = unexplained / (len(solution.fun) - len(start))
    # A fit of the wrong kind leaves parameters undetermined, whose errors are to be great: of a resonance that is not
    # there, gain, corner and Q; of a low-pass on a resonance at the band's end, the corner.
    _, singular, directions = np.linalg.svd(np.asarray(solution.jac), full_matrices=False)
    singular = np.maximum(singular, np.finfo(np.float64).eps * singular[0])
    errors = _CONFIDENCE * np.sqrt(variance) * np.linalg.norm(directions / singular[:, None], axis=0)
    stroke_um, fitted_corner_hz = 2 * np.exp(solution.x[0]), np.exp(solution.x[1])
    fitted_quality = float(np.exp(solution.x[4])) if resonant else None
    return Fit(
        corner_hz=float(fitted_corner_hz),
        corner_error_hz=float(fitted_corner_hz * errors[1]),
        quality=fitted_quality,
        quality_error=None if fitted_quality is None else fitted_quality * float(errors[4]),
        stroke_um=float(stroke_um),
        stroke_error_um=float(stroke_um * errors[0]),
        delay_ms=1e3 * delay_s + float(solution.x[2]),
        drift_ppm=float(solution.x[3]),
        unexplained=unexplained,
    )
