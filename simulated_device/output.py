"""From decoded samples to DAC codes: units, resampling, compensation, then gain, fades and limits; exact in any pieces.

The host computes the same with `render` and compares it with what the controller played: every step gives the same bits
however the samples are cut into pieces.
"""

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy import signal, special

from codec import Decoded
from device_protocol.coded_stream import StreamHeader
from simulated_device.actuator import Actuator, Codes, Filter, Samples

_WideCodes: TypeAlias = NDArray[np.int64]

# Acceleration becomes displacement above this frequency: fourth-order Butterworth high-pass, then double integration.
HIGH_PASS_HZ = 20.0
# A ramp of 5 ms is short to the touch, and its spectrum lies below the band of textures: no click.
FADE_SECONDS = 0.005
GAIN_RAMP_SECONDS = 0.02

# The power limit weighs the past by exp(-t / 1 s), in blocks of 10 ms, and turns the drive down within two knees below
# the limit; the knee is this part of the limit, and at most so much.
_POWER_SECONDS = 1.0
_POWER_BLOCK_SECONDS = 0.01
_POWER_KNEE_PART = 0.2
_POWER_LARGEST_KNEE = 0.05

# Resampler: Kaiser-windowed sinc of 16 taps at the lower of the two rates, stop band 60 dB. Its -6 dB point is .9 of
# the lower rate's half: at 2800 Hz flat to 940 Hz, and its delay is 8 samples, 2.9 ms.
_TAPS = 16
_KAISER_BETA = signal.kaiser_beta(60.0)
_BAND = 0.9

_DECODED_FULL_SCALE = 32768.0
# In parts of full scale, below any code of a DAC.
_SMALLEST_STEP = 1e-9


@lru_cache(maxsize=8)
def _resampling_filter(up: int, down: int) -> tuple[Samples, int]:
    """Return the filter (up, taps) and its delay in input samples, for a rate that becomes up / down of what it was.

    Row p is for a time p / up of a sample after an input sample; each row has a sum of 1.
    """
    if up == down:
        return np.ones((1, 1)), 0
    delay_samples = math.ceil(_TAPS / 2 * max(1.0, down / up))
    time = np.arange(2 * delay_samples)[None, :] + np.arange(up)[:, None] / up - delay_samples
    window = special.i0(_KAISER_BETA * np.sqrt(np.maximum(0.0, 1 - (time / delay_samples) ** 2)))
    table = np.sinc(_BAND * min(1.0, up / down) * time) * window
    return table / table.sum(axis=1, keepdims=True), delay_samples


def _raised_cosine(samples: int) -> Samples:
    """Return the way from 0 to 1 in so many steps, both included."""
    return np.asarray((1 - np.cos(np.pi * np.arange(samples + 1) / samples)) / 2)


class Resampler:
    """Changes the rate by a rational factor with a linear-phase filter; keeps state; passes equal rates unchanged.

    Output sample n lies at input time n * input_rate / output_rate, `delay_samples` input samples late.
    """

    def __init__(self, input_rate_hz: int, output_rate_hz: int, channels: int) -> None:
        divisor = math.gcd(input_rate_hz, output_rate_hz)
        self._up = output_rate_hz // divisor
        self._down = input_rate_hz // divisor
        self._table, self.delay_samples = _resampling_filter(self._up, self._down)
        self._history = np.zeros((self._table.shape[1] - 1, channels))
        self._inputs = 0
        self._outputs = 0

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


class _Joints:
    """Keeps the output steady where a recording that does not close on itself begins again, and where it ends.

    A next iteration that begins farther from the last value than the largest step within the recording is faded in
    from that value, held: wholly from twice that step on, less below, so that no step is larger than within. One that
    closes on itself passes unchanged. The first `unmeasured` samples come before the recording.
    """

    def __init__(self, rate_hz: int, channels: int, unmeasured: int) -> None:
        self.last = np.zeros(channels)
        self._fall = 1 - _raised_cosine(max(1, round(FADE_SECONDS * rate_hz)))[1:, None]
        self._held = self.last
        self._held_share = np.zeros((0, channels))  # of the samples to come
        self._before = self.last
        self._largest_step = np.zeros(channels)
        self._unmeasured = unmeasured + 1
        self._joining = False

    def join(self) -> None:
        """State that the next sample begins another iteration."""
        self._joining = True

    def push(self, samples: Samples) -> Samples:
        """Take samples (n, channels); return as many."""
        if not len(samples):
            return samples
        steps = np.abs(np.diff(samples, axis=0, prepend=self._before[None]))
        if self._joining:
            self._joining = False
            self._unmeasured = 1
            self._held = self.last
            jump, largest = np.abs(samples[0] - self.last), self._largest_step
            self._held_share = self._fall * np.clip((jump - largest) / np.maximum(largest, _SMALLEST_STEP), 0.0, 1.0)
        measured = steps[self._unmeasured :].max(axis=0, initial=0.0)
        self._largest_step = np.maximum(self._largest_step, measured)
        self._unmeasured = max(0, self._unmeasured - len(samples))
        self._before = samples[-1]
        share, self._held_share = self._held_share[: len(samples)], self._held_share[len(samples) :]
        joined = samples.copy()
        joined[: len(share)] += share * (self._held - samples[: len(share)])
        self.last = joined[-1]
        return joined


class Drive:
    """Turns decoded int16 samples into the drive at the DAC's rate, in parts of full scale, before gain and limits.

    Unit "full scale": full scale drives the actuator fully. "um": displacement from rest. "m/s^2": acceleration, made
    displacement by `displacement_filter`. Then the DAC's rate, and the actuator's inverse if `compensation` is on.
    `decoder_delay_samples`: decoded samples before the recording begins.
    """

    def __init__(
        self, header: StreamHeader, actuator: Actuator, compensation: bool, decoder_delay_samples: int = 0
    ) -> None:
        channels = header.channels
        self._scale = np.array(header.gains) / _DECODED_FULL_SCALE
        if header.unit != "full scale":
            self._scale = self._scale / actuator.excursion_um
        self._integrator = None
        if header.unit == "m/s^2":
            self._integrator = _StatefulFilter(displacement_filter(header.rate_hz), channels)
        self._joints = _Joints(header.rate_hz, channels, decoder_delay_samples)
        self._resampler = Resampler(header.rate_hz, actuator.dac_rate_hz, channels)
        self._inverse = _StatefulFilter(actuator.inverse(), channels) if compensation else None
        self._rate_hz, self._dac_rate_hz = header.rate_hz, actuator.dac_rate_hz
        self.delay_seconds = self._resampler.delay_samples / header.rate_hz
        if compensation:
            self.delay_seconds += actuator.low_pass_delay_seconds

    def push(self, decoded: Decoded) -> Samples:
        """Take int16 (n, channels); return the drive (m, channels) that they complete."""
        wanted = decoded * self._scale
        if self._integrator is not None:
            wanted = self._integrator.push(wanted)
        return self._to_drive(self._joints.push(wanted))

    def join(self) -> None:
        """State that the next sample begins another iteration: a jump to it is smoothed within FADE_SECONDS."""
        self._joints.join()

    def finish(self) -> Samples:
        """Return what is still in the resampler; the last value is held, so that nothing jumps at the end."""
        return self._to_drive(np.tile(self._joints.last, (self._resampler.delay_samples, 1)))

    def _to_drive(self, wanted: Samples) -> Samples:
        drive = self._resampler.push(wanted)
        return drive if self._inverse is None else self._inverse.push(drive)

    def drive_samples(self, decoded_samples: int) -> int:
        """Return the drive samples before the one with which the decoded sample of this number comes out."""
        return math.ceil((decoded_samples + self._resampler.delay_samples) * self._dac_rate_hz / self._rate_hz)


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
        self._rise = _raised_cosine(max(1, round(FADE_SECONDS * actuator.dac_rate_hz)))
        self._fade = np.concatenate((np.zeros(hold_samples), self._rise[1:]))
        self._gain = np.full(1, gain)
        self._power = _PowerLimit(actuator, channels)

    @property
    def at_rest(self) -> bool:
        """Whether the last code was 0 in all channels."""
        return not self._code.any()

    @property
    def recovery_samples(self) -> int:
        """DAC samples at rest after which another stream may begin as if none had been before."""
        return self._power.recovery_samples

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
        """Return DAC codes int16 (n, channels) from the last one to rest, none at rest; `play` fades in after them."""
        self._fade = self._rise[1:]
        ramp = np.rint(self._rise[-2::-1, None] * self._code).astype(np.int64)
        pieces = [ramp[:0] if self.at_rest else self._step(ramp)]
        while not self.at_rest:
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
    """Keeps the mean squared drive of each channel, over any second, at or below the actuator's limit.

    Once a block, mean += share (block - mean), and the squared factor of the next is (limit - knee - mean) / knee, at
    least 0 and at most 1: the mean stays below limit - knee. It starts at, and never falls below, its floor
    limit - 2 knee: from 0 it would let full drive pass for most of the first second. With
    mean' >= (drive^2 - mean) / 1 s, the mean of drive^2 over any second is at most the rise of `mean` in it, which is
    at most a knee, plus its height, at most limit - knee. Drive below the floor is left alone. The factor moves
    linearly within a block: no click.
    """

    def __init__(self, actuator: Actuator, channels: int) -> None:
        self._knee = min(_POWER_LARGEST_KNEE, _POWER_KNEE_PART * actuator.power_limit)
        self._top = actuator.power_limit - self._knee
        self._floor = self._top - self._knee
        self._block_samples = max(1, round(_POWER_BLOCK_SECONDS * actuator.dac_rate_hz))
        self._share = self._block_samples / (_POWER_SECONDS * actuator.dac_rate_hz)
        self._block_full_power = self._block_samples * actuator.full_scale**2
        self._mean = np.full(channels, self._floor)
        self._from = np.ones(channels)
        self._to = np.ones(channels)
        self._energy = np.zeros(channels, np.int64)
        self._measured = 0

    @property
    def recovery_samples(self) -> int:
        """DAC samples at rest after which the mean is at its floor, where every stream begins."""
        samples, mean = 0, self._mean
        if self._measured:
            samples, mean = self._block_samples - self._measured, self._next_mean()
        while (mean > self._floor).any():
            samples += self._block_samples
            mean = mean - self._share * mean
        return samples

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
                self._mean = self._next_mean()
                self._from = self._to
                self._to = np.sqrt(np.clip((self._top - self._mean) / self._knee, 0.0, 1.0))
                self._energy = np.zeros_like(self._energy)
                self._measured = 0

    def _next_mean(self) -> Samples:
        """Return the mean at the end of this block if it is at rest from now on."""
        mean = self._mean + self._share * (self._energy / self._block_full_power - self._mean)
        return np.asarray(np.maximum(mean, self._floor))


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
    drive = Drive(header, actuator, compensation, delay_samples)
    dac = Dac(actuator, header.channels, gain, compensation, drive.drive_samples(delay_samples))
    end = recording_end(header, delay_samples)
    codes = [dac.play(drive.push(decoded[:end]))]
    for _ in range(loops - 1):
        drive.join()
        codes.append(dac.play(drive.push(decoded[delay_samples:end])))
    codes += [dac.play(drive.finish()), dac.ramp_down()]
    return np.concatenate(codes), dac.counts
