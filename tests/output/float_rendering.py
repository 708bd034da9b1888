"""The output in floating point, a whole recording at a time: what vibrocast/output.h computes in integers."""

import math

import numpy as np
from scipy import signal, special

from vibrocast.codec.interface import Decoded
from vibrocast.device_protocol.coded_stream import StreamHeader
from vibrocast.output.actuator import Actuator, Codes, Samples
from vibrocast.output.rendering import displacement_filter


def render(
    header: StreamHeader, decoded: Decoded, delay_samples: int, actuator: Actuator, compensation: bool, loops: int
) -> Codes:
    """Return the DAC codes (n, 1) of a stream of one channel at gain 1; see output.rendering.render."""
    end = None if header.samples is None else delay_samples + header.samples
    starts = np.cumsum([0, len(decoded[:end]), *[len(decoded[delay_samples:end])] * (loops - 1)])
    wanted = np.concatenate([decoded[:end, 0], *[decoded[delay_samples:end, 0]] * (loops - 1)]) / 32768
    wanted = wanted * header.gains[0] / (1.0 if header.unit == "full scale" else actuator.excursion_um)
    if header.unit == "m/s^2":
        wanted = np.asarray(signal.lfilter(*displacement_filter(header.rate_hz), wanted))
    wanted = _joined(wanted, starts[1:-1].tolist(), delay_samples, header.rate_hz)
    drive, resampler_delay = _resampled(wanted, header.rate_hz, actuator.dac_rate_hz)
    if compensation:
        drive = np.asarray(signal.lfilter(*actuator.inverse(), drive))
    hold = math.ceil((delay_samples + resampler_delay) * actuator.dac_rate_hz / header.rate_hz)
    rise = _raised_cosine(_fade_samples(actuator.dac_rate_hz))
    fade = np.concatenate((np.zeros(hold), rise[1:], np.ones(len(drive))))[: len(drive)]
    lowest = -actuator.code_limit - (actuator.code_limit == actuator.full_scale - 1)
    return _limited(np.clip(np.rint(drive * fade * actuator.full_scale), lowest, actuator.code_limit), rise, actuator)


def _fade_samples(rate_hz: int) -> int:
    return max(1, (rate_hz + 100) // 200)


def _raised_cosine(samples: int) -> Samples:
    return np.asarray((1 - np.cos(np.pi * np.arange(samples + 1) / samples)) / 2)


def _joined(wanted: Samples, joints: list[int], delay_samples: int, rate_hz: int) -> Samples:
    """Fade in from the last value what begins with a jump beyond the largest step so far."""
    joined, fall = wanted.copy(), 1 - _raised_cosine(_fade_samples(rate_hz))[1:]
    steps = np.abs(np.diff(wanted, prepend=0.0))
    steps[[*range(min(delay_samples + 1, len(steps))), *joints]] = 0.0
    for joint in joints:
        held, largest = joined[joint - 1], steps[:joint].max(initial=0.0)
        share = np.clip((abs(wanted[joint] - held) - largest) / max(largest, 1e-9), 0.0, 1.0)
        part = slice(joint, joint + len(fall))
        joined[part] += (share * fall)[: len(joined[part])] * (held - wanted[part])
    return joined


def _resampled(wanted: Samples, rate_hz: int, dac_rate_hz: int) -> tuple[Samples, int]:
    """Return the samples of the DAC's rate and the delay in samples of the stream; the last value is held for it.

    Kaiser-windowed sinc over 8 of its zero crossings to either side, at the lower rate, -6 dB at 0.9 of half of it.
    """
    if rate_hz == dac_rate_hz:
        return wanted, 0
    crossing = max(1.0, rate_hz / dac_rate_hz)
    delay = math.ceil(8 * crossing)
    held = np.concatenate((np.zeros(2 * delay), wanted, np.full(delay, wanted[-1] if len(wanted) else 0.0)))
    whole, phase = np.divmod(np.arange(-(-(len(wanted) + delay) * dac_rate_hz // rate_hz)) * rate_hz, dac_rate_hz)
    time = (np.arange(2 * delay)[None, :] + phase[:, None] / dac_rate_hz - delay) / crossing
    end = np.clip(256 * (8 - np.abs(time)), 0.0, 1.0)  # where the table's last step leads to 0
    window = end * special.i0(5.65326 * np.sqrt(np.maximum(0.0, 1 - (time / 8) ** 2)))
    taps = np.sinc(0.9 * time) * window
    taps /= taps.sum(axis=1, keepdims=True)
    return np.sum(taps * held[2 * delay + whole[:, None] - np.arange(2 * delay)], axis=1), delay


def _limited(wanted: Samples, rise: Samples, actuator: Actuator) -> Codes:
    """Apply the limits on mean power and slew, then go to rest."""
    knee = min(0.05, 0.2 * actuator.power_limit)
    top, floor = actuator.power_limit - knee, actuator.power_limit - 2 * knee
    block = max(1, round(actuator.dac_rate_hz / 100))
    mean, before, after = floor, 1.0, 1.0
    codes = [0]

    def step(target: float) -> None:
        nonlocal mean, before, after
        codes.append(round(np.clip(target, codes[-1] - actuator.code_step_limit, codes[-1] + actuator.code_step_limit)))
        if (len(codes) - 1) % block == 0:
            power = float(np.mean((np.array(codes[-block:]) / actuator.full_scale) ** 2))
            mean = max(floor, mean + block / actuator.dac_rate_hz * (power - mean))
            before, after = after, math.sqrt(min(1.0, max(0.0, (top - mean) / knee)))

    for number, code in enumerate(wanted):
        step(np.rint(code * (before + (after - before) * (number % block + 1) / block)))
    if codes[-1]:
        for target in np.rint(rise[-2::-1] * codes[-1]):
            step(target)
    while codes[-1]:
        step(0)
    return np.array(codes[1:], np.int16).reshape(-1, 1)
