"""From decoded samples to DAC codes: units, resampling, compensation, then gain, fades and limits; exact in any pieces.

The host computes the same with `render` and compares it with what the controller played: every step gives the same bits
however the samples are cut into pieces.
"""

import math
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from codec import Decoded
from device_protocol.coded_stream import StreamHeader
from simulated_device.actuator import Actuator, Codes, Filter, Samples

_WideCodes: TypeAlias = NDArray[np.int64]

# Acceleration becomes displacement above this frequency: fourth-order Butterworth high-pass, then double integration.
HIGH_PASS_HZ = 20.0
# A ramp of 5 ms is short to the touch, and its spectrum lies below the band of textures: no click.
FADE_SECONDS = 0.005
GAIN_RAMP_SECONDS = 0.02

# The power limit looks at the mean over 1 s, in blocks of 1/50 s, and turns the drive down softly below the limit.
_POWER_SECONDS = 1.0
_POWER_BLOCK_SECONDS = 0.02
_POWER_KNEE = 0.1

# Resampler: Kaiser-windowed sinc of 16 taps at the lower of the two rates, stop band 60 dB. Its -6 dB point is .9 of
# the lower rate's half: at 2800 Hz flat to 940 Hz, and its delay is 8 samples, 2.9 ms.
_TAPS = 16
_KAISER_BETA = signal.kaiser_beta(60.0)
_BAND = 0.9

_DECODED_FULL_SCALE = 32768.0


class Resampler:
    """Changes the rate by a rational factor with a linear-phase filter; keeps state; passes equal rates unchanged.

    Output sample n lies at input time n * input_rate / output_rate, `delay_samples` input samples late.
    """

    def __init__(self, input_rate_hz: int, output_rate_hz: int, channels: int) -> None:
        divisor = math.gcd(input_rate_hz, output_rate_hz)
        self._up = output_rate_hz // divisor
        self._down = input_rate_hz // divisor
        self.delay_samples = 0
        taps = 1
        if self._up != self._down:
            self.delay_samples = math.ceil(_TAPS / 2 * max(1.0, input_rate_hz / output_rate_hz))
            taps = 2 * self.delay_samples
        self._table = self._phases(taps, min(1.0, output_rate_hz / input_rate_hz))
        self._history = np.zeros((taps - 1, channels))
        self._inputs = 0
        self._outputs = 0

    def _phases(self, taps: int, rate_ratio: float) -> Samples:
        """Return the filter (phases, taps), each phase with a sum of 1; row p is for a fraction p / up of a sample."""
        if taps == 1:
            return np.ones((1, 1))
        fraction = np.arange(self._up)[:, None] / self._up
        time = np.arange(taps)[None, :] + fraction - self.delay_samples
        window = np.i0(_KAISER_BETA * np.sqrt(np.maximum(0.0, 1 - (time / self.delay_samples) ** 2)))
        table = np.sinc(_BAND * rate_ratio * time) * window
        return np.asarray(table / table.sum(axis=1, keepdims=True))

    def push(self, samples: Samples) -> Samples:
        """Take samples (n, channels); return those of the output rate that they complete (m, channels)."""
        first = self._inputs - len(self._history)
        held = np.concatenate((self._history, samples))
        self._inputs += len(samples)
        end = -(-self._inputs * self._up // self._down)
        whole, phase = np.divmod(np.arange(self._outputs, end) * self._down, self._up)
        self._outputs = end
        result = np.zeros((len(whole), held.shape[1]))
        # Tap by tap, so that the order of the additions never depends on the size of a piece.
        for tap in range(self._table.shape[1]):
            result += self._table[phase, tap, None] * held[whole - tap - first]
        self._history = held[len(held) - len(self._history) :]
        return result


class _StatefulFilter:
    """An IIR filter that starts at rest and keeps its state between pieces."""

    def __init__(self, coefficients: Filter, channels: int) -> None:
        self._b, self._a = coefficients
        self._state = np.zeros((max(len(self._b), len(self._a)) - 1, channels))

    def push(self, samples: Samples) -> Samples:
        if not len(samples):  # of nothing, scipy returns a state that is not the one before
            return samples
        filtered, self._state = signal.lfilter(self._b, self._a, samples, axis=0, zi=self._state)
        return np.asarray(filtered)


def displacement_filter(rate_hz: int) -> Filter:
    """Return (b, a): from acceleration, m/s^2, to displacement, um, above HIGH_PASS_HZ, one sample late.

    Double integration by Numerov's rule, y[n+1] - 2 y[n] + y[n-1] = T^2 (x[n+1] + 10 x[n] + x[n-1]) / 12 (Hairer,
    Norsett, Wanner, Solving Ordinary Differential Equations I, III.10), exact to .03 dB at a seventh of the rate. Its
    double pole at z = 1 is cancelled by two of the four zeros of the high-pass, so the whole is stable.
    """
    b, a = signal.butter(4, HIGH_PASS_HZ, btype="highpass", fs=rate_hz)
    um_per_metre = 1e6
    numerov = np.array([1.0, 10.0, 1.0]) * (um_per_metre / (12.0 * rate_hz**2))
    return b[0] * np.convolve(numerov, [1.0, -2.0, 1.0]), np.asarray(a)


class Drive:
    """Turns decoded int16 samples into the drive at the DAC's rate, in parts of full scale, before gain and limits.

    Unit "full scale": full scale drives the actuator fully. "um": displacement from rest. "m/s^2": acceleration, made
    displacement by `displacement_filter`. Then the DAC's rate, and the actuator's inverse if `compensation` is on.
    """

    def __init__(self, header: StreamHeader, actuator: Actuator, compensation: bool) -> None:
        channels = header.channels
        self._scale = np.array(header.gains) / _DECODED_FULL_SCALE
        self._filters: list[_StatefulFilter | Resampler] = []
        if header.unit != "full scale":
            self._scale = self._scale / actuator.excursion_um
        if header.unit == "m/s^2":
            self._filters.append(_StatefulFilter(displacement_filter(header.rate_hz), channels))
        resampler = Resampler(header.rate_hz, actuator.dac_rate_hz, channels)
        self._filters.append(resampler)
        if compensation:
            self._filters.append(_StatefulFilter(actuator.inverse(), channels))
        self._channels = channels
        self._rate_hz, self._dac_rate_hz = header.rate_hz, actuator.dac_rate_hz
        self._delay_samples = resampler.delay_samples
        self.delay_seconds = self._delay_samples / header.rate_hz

    def push(self, decoded: Decoded) -> Samples:
        """Take int16 (n, channels); return the drive (m, channels) that they complete."""
        drive = decoded * self._scale
        for stage in self._filters:
            drive = stage.push(drive)
        return drive

    def finish(self) -> Samples:
        """Return what is still in the resampler."""
        return self.push(np.zeros((self._delay_samples, self._channels), np.int16))

    def drive_samples(self, decoded_samples: int) -> int:
        """Return the drive samples before the one with which the decoded sample of this number comes out."""
        return math.ceil((decoded_samples + self._delay_samples) * self._dac_rate_hz / self._rate_hz)


@dataclass
class LimitCounts:
    """DAC samples of all channels that each limit changed."""

    compensation_clipped: int = 0
    voltage_limited: int = 0
    slew_limited: int = 0
    power_limited: int = 0


class Dac:
    """Turns drive into DAC codes: gain, fade in, then limits on voltage, mean power and slew, which nothing overrides.

    Starts at rest with `hold_samples` at rest, then fades in. The limits act on integer codes and the power is the mean
    of their exact squares, so that no code depends on how the samples were cut into pieces.
    A code beyond the voltage limit counts as clipped compensation while `compensation` is on.
    """

    def __init__(
        self, actuator: Actuator, channels: int, gain: float, compensation: bool, hold_samples: int = 0
    ) -> None:
        self.counts = LimitCounts()
        self._actuator = actuator
        self._compensation = compensation
        self._code = np.zeros(channels, np.int64)
        fade_samples = max(1, round(FADE_SECONDS * actuator.dac_rate_hz))
        self._raised_cosine = (1 - np.cos(np.pi * np.arange(fade_samples + 1) / fade_samples)) / 2
        self._fade = np.concatenate((np.zeros(hold_samples), self._raised_cosine[1:]))
        self._gain = np.full(1, gain)
        self._power = _PowerLimit(actuator, channels)

    def set_gain(self, gain: float) -> None:
        """Move to another gain along a ramp of GAIN_RAMP_SECONDS."""
        ramp_samples = max(1, round(GAIN_RAMP_SECONDS * self._actuator.dac_rate_hz))
        self._gain = np.linspace(self._gain[0], gain, ramp_samples + 1)

    def play(self, drive: Samples) -> Codes:
        """Take drive (n, channels); return DAC codes int16 (n, channels)."""
        fade, self._fade = self._fade[: len(drive)], self._fade[len(drive) :]
        ramp, self._gain = self._gain[: len(drive)], self._gain[min(len(drive), len(self._gain) - 1) :]
        factors = np.full(len(drive), self._gain[0])
        factors[: len(ramp)] = ramp
        factors[: len(fade)] *= fade
        return self._limit(drive * factors[:, None])

    def ramp_down(self) -> Codes:
        """Return DAC codes int16 (n, channels) that go from the last one to rest; `play` fades in after them."""
        self._fade = self._raised_cosine[1:]
        ramp = np.rint(self._raised_cosine[-2::-1, None] * self._code).astype(np.int64)
        pieces = [self._step(ramp)]
        while self._code.any():
            pieces.append(self._step(np.zeros((1, len(self._code)), np.int64)))
        return np.concatenate(pieces).astype(np.int16)

    def _limit(self, drive: Samples) -> Codes:
        wanted = self._within_voltage(drive)
        pieces = [np.zeros((0, len(self._code)), np.int64)]
        while len(wanted):
            factors = self._power.factors(len(wanted))
            piece, wanted = wanted[: len(factors)], wanted[len(factors) :]
            self.counts.power_limited += int(np.count_nonzero((factors < 1) & (piece != 0)))
            pieces.append(self._step(np.rint(piece * factors).astype(np.int64)))
        return np.concatenate(pieces).astype(np.int16)

    def _within_voltage(self, drive: Samples) -> _WideCodes:
        limit = self._actuator.code_limit
        codes = np.rint(drive * self._actuator.full_scale)
        # At full DAC scale the lowest code is one farther from rest than the highest.
        clipped = np.clip(codes, -limit - (limit == self._actuator.full_scale - 1), limit)
        changed = int(np.count_nonzero(clipped != codes))
        if self._compensation:
            self.counts.compensation_clipped += changed
        else:
            self.counts.voltage_limited += changed
        return clipped.astype(np.int64)

    def _step(self, codes: _WideCodes) -> _WideCodes:
        """Go through `codes` no faster than the slew limit; account for their power."""
        step = self._actuator.code_step_limit
        limited = codes.copy()
        too_fast = np.abs(np.diff(codes, axis=0, prepend=self._code[None])) > step
        for channel in np.flatnonzero(too_fast.any(axis=0)):
            last = int(self._code[channel])
            for index, code in enumerate(codes[:, channel].tolist()):
                last = max(last - step, min(last + step, code))
                limited[index, channel] = last
        self.counts.slew_limited += int(np.count_nonzero(limited != codes))
        if len(limited):
            self._code = limited[-1]
        self._power.measure(limited)
        return limited


class _PowerLimit:
    """Keeps the running mean of the squared drive of each channel below the actuator's limit.

    Once a block, mean += share (block - mean), and the squared factor of the next block is (limit - mean) / knee, at
    most 1: it reaches 0 before the mean reaches the limit. The factor moves linearly within a block: no click.
    """

    def __init__(self, actuator: Actuator, channels: int) -> None:
        self._limit = actuator.power_limit
        self._knee = min(_POWER_KNEE, self._limit / 2)
        self._block_samples = max(1, round(_POWER_BLOCK_SECONDS * actuator.dac_rate_hz))
        self._share = self._block_samples / (_POWER_SECONDS * actuator.dac_rate_hz)
        self._block_full_power = self._block_samples * actuator.full_scale**2
        self._mean = np.zeros(channels)
        self._from = np.ones(channels)
        self._to = np.ones(channels)
        self._energy = np.zeros(channels, np.int64)
        self._measured = 0

    def factors(self, count: int) -> Samples:
        """Return the factors (at most `count`, channels) up to the end of this block at most."""
        end = min(self._block_samples, self._measured + count)
        part = np.arange(self._measured + 1, end + 1)[:, None] / self._block_samples
        return np.asarray(self._from + (self._to - self._from) * part)

    def measure(self, codes: _WideCodes) -> None:
        """Account for codes (n, channels) that were played."""
        while len(codes):
            piece = codes[: self._block_samples - self._measured]
            codes = codes[len(piece) :]
            self._energy += (piece * piece).sum(axis=0)
            self._measured += len(piece)
            if self._measured == self._block_samples:
                self._mean += self._share * (self._energy / self._block_full_power - self._mean)
                self._from = self._to
                self._to = np.sqrt(np.clip((self._limit - self._mean) / self._knee, 0.0, 1.0))
                self._energy = np.zeros_like(self._energy)
                self._measured = 0


def recording_end(header: StreamHeader, delay_samples: int) -> int | None:
    """Return the decoded samples of one iteration up to the recording's end, None for a live stream.

    Past it comes only padding: the output ramps down from here on.
    """
    return None if header.samples is None else delay_samples + header.samples


def render(
    header: StreamHeader,
    decoded: Decoded,
    delay_samples: int,
    actuator: Actuator,
    *,
    compensation: bool = True,
    gain: float = 1.0,
    loops: int = 1,
) -> tuple[Codes, LimitCounts]:
    """Return all DAC codes int16 (n, channels) of a stream played `loops` times without a pause, and what limits did.

    `decoded`: int16 (samples, channels), every packet of one pass; `delay_samples`: the decoder's. Bit for bit what
    a controller with this actuator puts out and its capture returns.
    """
    drive = Drive(header, actuator, compensation)
    dac = Dac(actuator, header.channels, gain, compensation, drive.drive_samples(delay_samples))
    end = recording_end(header, delay_samples)
    played = drive.push(np.concatenate([decoded[:end]] + [decoded[delay_samples:end]] * (loops - 1)))
    codes = [dac.play(played), dac.play(drive.finish()), dac.ramp_down()]
    return np.concatenate(codes), dac.counts
