"""From decoded samples to DAC codes, compensation and limits included, by vibrocast/output.h: the same integers.

The host computes them with `render`, and compares them with the controller's output. Every step gives the same bits,
however the samples are cut into pieces.
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from vibrocast.device_protocol.coded_stream import UNITS, StreamHeader
from vibrocast.firmware.native_core import Structure, ffi, float_bits, library
from vibrocast.output.actuator import Actuator, Codes, Filter
from vibrocast.output.actuator_constants import SHIPPED, constants

DriveSamples: TypeAlias = NDArray[np.int32]

# Above this frequency, acceleration becomes displacement: fourth-order Butterworth high-pass, then double integration.
HIGH_PASS_HZ = 20.0
# A ramp of 5 ms feels short, and its spectrum lies below the band of textures: no click.
FADE_SECONDS = 0.005

_RAMP_SAMPLES = 256


def displacement_filter(rate_hz: int) -> Filter:
    """Return (b, a): from acceleration, m/s^2, to displacement, um, above HIGH_PASS_HZ, one sample late.

    Double integration by Numerov's rule, y[n+1] - 2 y[n] + y[n-1] = T^2 (x[n+1] + 10 x[n] + x[n-1]) / 12 (Hairer,
    Norsett, Wanner, Solving Ordinary Differential Equations I, III.10), exact to 0.03 dB at a seventh of the rate. Two
    of the four zeros of the high-pass cancel its double pole at z = 1, so the whole is stable.
    """
    from scipy import signal

    b, a = signal.butter(4, HIGH_PASS_HZ, btype="highpass", fs=rate_hz)
    um_per_metre = 1e6
    numerov = np.array([1.0, 10.0, 1.0]) * (um_per_metre / (12.0 * rate_hz**2))
    return b[0] * np.convolve(numerov, [1.0, -2.0, 1.0]), np.asarray(a)


@lru_cache(maxsize=64)
def actuator_structure(actuator: Actuator) -> Any:
    """Return an actuator as the core's vc_actuator. Raises ValueError if its numbers do not fit."""
    core = library()  # declares the structure
    for name, shipped in SHIPPED.items():
        if actuator == shipped:  # its constants are there, and to compute them takes the import of scipy.signal
            return ffi.addressof(core, f"vc_{name}")
    return ffi.new("vc_actuator *", constants(actuator))


def _stream_structure(header: StreamHeader) -> Any:
    gains = [int.from_bytes(struct.pack(">f", gain)[:2], "big") for gain in header.gains]
    unit = UNITS.index(header.unit)
    return ffi.new(
        "vc_output_stream *", {"rate_hz": header.rate_hz, "unit": unit, "channels": len(gains), "gain": gains}
    )


class Drive:
    """Turns decoded int16 samples into the drive at the DAC's rate, before gain and limits: int32, 2^25 = full scale.

    Unit "full scale": full scale drives the actuator fully. "um": displacement from rest. "m/s^2": acceleration, which
    `displacement_filter` turns into displacement in units of the gain / (2 pi HIGH_PASS_HZ)^2. Then follow the
    resampling to the DAC's rate and, with `compensation`, the actuator's inverse. `decoder_delay_samples`: decoded
    samples before the recording begins. Raises ValueError, with the reason, if the output cannot play such a stream.
    """

    def __init__(
        self, header: StreamHeader, actuator: Actuator, compensation: bool, decoder_delay_samples: int = 0
    ) -> None:
        self._channels = header.channels
        self._rate_hz, self._dac_rate_hz = header.rate_hz, actuator.dac_rate_hz
        self._actuator = actuator_structure(actuator)
        stream = _stream_structure(header)
        size = library().vc_drive_size(self._actuator, stream)
        if not size:
            raise ValueError(
                f"a stream of {header.unit} at {header.rate_hz} Hz cannot be played by a DAC at {actuator.dac_rate_hz} "
                "Hz; resample it first"
            )
        self._drive = Structure(size, "vc_drive *")
        library().vc_drive_init(self._drive.pointer, self._actuator, stream, compensation, decoder_delay_samples)
        self.delay_seconds = library().vc_drive_delay_samples(self._drive.pointer) / header.rate_hz
        if compensation:
            self.delay_seconds += actuator.low_pass_delay_seconds

    def push(self, decoded: NDArray[np.int16]) -> DriveSamples:
        """Take int16 (n, channels); return the drive (m, channels) that they complete."""
        decoded = np.ascontiguousarray(decoded)
        drive = self._room(len(decoded))
        pointer, made = ffi.cast("int16_t *", decoded.ctypes.data), ffi.new("uint32_t *")
        library().vc_drive_push(self._drive.pointer, pointer, len(decoded), _drive_pointer(drive), len(drive), made)
        return drive[: made[0]]

    def join(self) -> None:
        """State that the next sample begins another iteration: a jump to it is smoothed within FADE_SECONDS."""
        library().vc_drive_join(self._drive.pointer)

    def finish(self) -> DriveSamples:
        """Return the rest from the resampler; the last value is held, so that nothing jumps at the end."""
        drive = self._room(library().vc_drive_delay_samples(self._drive.pointer))
        return drive[: library().vc_drive_finish(self._drive.pointer, _drive_pointer(drive), len(drive))]

    def drive_samples(self, decoded_samples: int) -> int:
        """Return the number of drive samples before the one at which this decoded sample comes out."""
        return int(library().vc_drive_samples(self._drive.pointer, decoded_samples))

    def _room(self, decoded_samples: int) -> DriveSamples:
        """Return room for all the drive that this number of decoded samples completes."""
        return np.empty((-(-decoded_samples * self._dac_rate_hz // self._rate_hz), self._channels), np.int32)


def _drive_pointer(drive: DriveSamples) -> Any:
    return ffi.cast("int32_t *", drive.ctypes.data)


def _codes_pointer(codes: Codes) -> Any:
    return ffi.cast("int16_t *", codes.ctypes.data)


@dataclass
class LimitCounts:
    """Number of DAC samples, over all channels, that each limit changed."""

    compensation_clipped: int = 0
    voltage_limited: int = 0
    slew_limited: int = 0
    power_limited: int = 0


class Dac:
    """Turns the drive of a stream into DAC codes: gain, fade in, then limits on voltage, mean power and slew.

    Starts with `hold_samples` at rest, then fades in. Nothing overrides the limits. While `compensation` is on, a code
    beyond the voltage limit counts as clipped compensation. A gain above 65 536 counts as 65 536.
    """

    def __init__(
        self, header: StreamHeader, actuator: Actuator, gain: float, compensation: bool, hold_samples: int = 0
    ) -> None:
        self._channels = header.channels
        self._actuator = actuator_structure(actuator)
        self._dac = Structure(library().vc_dac_size(), "vc_dac *")
        stream = _stream_structure(header)
        library().vc_dac_init(self._dac.pointer, self._actuator, stream, float_bits(gain), compensation, hold_samples)

    @property
    def counts(self) -> LimitCounts:
        """Samples that the limits have changed so far."""
        counts = library().vc_dac_counts(self._dac.pointer)
        return LimitCounts(
            counts.compensation_clipped, counts.voltage_limited, counts.slew_limited, counts.power_limited
        )

    @property
    def recovery_samples(self) -> int:
        """DAC samples at rest after which another stream may begin as if there had been none before."""
        return int(library().vc_dac_recovery_samples(self._dac.pointer))

    def set_gain(self, gain: float) -> None:
        """Move to another gain along a ramp of 20 ms."""
        library().vc_dac_set_gain(self._dac.pointer, float_bits(gain))

    def play(self, drive: DriveSamples) -> Codes:
        """Take drive (n, channels); return DAC codes int16 (n, channels)."""
        drive = np.ascontiguousarray(drive)
        codes = np.empty((len(drive), self._channels), np.int16)
        library().vc_dac_play(self._dac.pointer, _drive_pointer(drive), len(drive), _codes_pointer(codes))
        return codes

    def ramp_down(self) -> Codes:
        """Return DAC codes int16 (n, channels) from the last one to rest, none at rest; `play` then fades in again."""
        library().vc_dac_begin_ramp(self._dac.pointer)
        pieces: list[Codes] = []
        while not pieces or len(pieces[-1]) == _RAMP_SAMPLES:
            piece = np.empty((_RAMP_SAMPLES, self._channels), np.int16)
            pieces.append(piece[: library().vc_dac_ramp(self._dac.pointer, _codes_pointer(piece), len(piece))])
        return np.concatenate(pieces)


def recording_end(header: StreamHeader, delay_samples: int) -> int | None:
    """Return the decoded samples of one iteration up to the recording's end, None for a live stream.

    Only padding follows: the output ramps down from there.
    """
    return None if header.samples is None else delay_samples + header.samples


def render(
    header: StreamHeader,
    decoded: NDArray[np.int16],
    delay_samples: int,
    actuator: Actuator,
    *,
    compensation: bool = True,
    gain: float = 1.0,
    loops: int = 1,
    behind: Sequence[tuple[StreamHeader, NDArray[np.int16], int]] = (),
) -> tuple[Codes, LimitCounts]:
    """Return all DAC codes int16 (n, channels) of a stream played `loops` times without a pause, and the limit counts.

    `decoded`: int16 (samples, channels), every packet of one pass; `delay_samples`: the decoder's. `behind`: header,
    samples and delay of each stream that was queued behind it. Bit for bit the output of a controller with this
    actuator, which its capture returns.
    """
    drive = Drive(header, actuator, compensation, delay_samples)
    dac = Dac(header, actuator, gain, compensation, drive.drive_samples(delay_samples))
    end = recording_end(header, delay_samples)
    codes = [dac.play(drive.push(decoded[:end]))]
    for _ in range(loops - 1):
        drive.join()
        codes.append(dac.play(drive.push(decoded[delay_samples:end])))
    for queued, samples, late in behind:
        drive.join()
        codes.append(dac.play(drive.push(samples[late : recording_end(queued, late)])))
    codes += [dac.play(drive.finish()), dac.ramp_down()]
    return np.concatenate(codes), dac.counts
