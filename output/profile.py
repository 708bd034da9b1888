"""A height profile rendered by the position of the hand, by firmware/core/profile.h: integers, the same everywhere."""

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from vibrocast.device_protocol.coded_stream import StreamHeader
from vibrocast.firmware.native_core import Structure, ffi, library
from vibrocast.output.actuator import Actuator, Codes
from vibrocast.output.rendering import Dac, Drive

# By how much later than they were taken positions from a host are rendered, and time constant of each of the two
# low-passes that smooth them: firmware/core/profile.h.
HAND_DELAY_US = 20_000
HAND_SMOOTHING_US = 4_000


def min_samples(samples_per_metre: int, dac_rate_hz: int) -> int:
    """Return the least samples that a profile must have to be rendered by such a DAC; 0 where none can be."""
    return int(library().vc_profile_least_samples(samples_per_metre, dac_rate_hz))


def octaves_step(samples_per_metre: int, dac_rate_hz: int) -> int:
    """Return how many samples of a profile a sample of its coarsest octave stands for: its period is a multiple."""
    return 1 << (min_samples(samples_per_metre, dac_rate_hz).bit_length() - 1)


def rendered(header: StreamHeader, actuator: Actuator) -> StreamHeader:
    """Return what a profile's header says of the heights that are rendered from it: um, at the DAC's rate."""
    return replace(header, unit="um", rate_hz=actuator.dac_rate_hz)


class Profile:
    """What is under the hand at every DAC sample.

    A profile of `samples` (at least `min_samples`) per channel is loaded once, positions of the hand come with their
    times, heights go out, in the profile's own integers.
    """

    def __init__(self, samples_per_metre: int, samples: int, channels: int, dac_rate_hz: int) -> None:
        self._channels = channels
        self._profile = Structure(library().vc_profile_size(samples, channels), "vc_profile *")
        library().vc_profile_init(self._profile.pointer, samples_per_metre, samples, channels, dac_rate_hz)

    def load(self, decoded: NDArray[np.int16]) -> None:
        """Take the next decoded samples, int16 (n, channels)."""
        decoded = np.ascontiguousarray(decoded)
        pointer = ffi.cast("int16_t *", decoded.ctypes.data)
        library().vc_profile_load(self._profile.pointer, pointer, len(decoded))

    def position(self, time_us: int, position_nm: int) -> bool:
        """Take where the hand was at a time; dropped unless later than the last one and within 2^40 nm.

        Return whether it came too late: the hand had moved on, and has been rendered as at rest.
        """
        return bool(library().vc_profile_position(self._profile.pointer, time_us, position_nm))

    def render(self, times_us: Iterable[int]) -> NDArray[np.int16]:
        """Return the heights int16 (n, channels) at the times of DAC samples that follow each other."""
        times = list(times_us)
        heights = np.empty((len(times), self._channels), np.int16)
        for time_us, row in zip(times, heights, strict=True):
            library().vc_profile_render(self._profile.pointer, time_us, ffi.cast("int16_t *", row.ctypes.data))
        return heights


def render(
    header: StreamHeader,
    decoded: NDArray[np.int16],
    delay_samples: int,
    positions: Sequence[tuple[int, int]],
    samples: int,
    actuator: Actuator,
    *,
    start_us: int = 0,
    compensation: bool = True,
    gain: float = 1.0,
) -> tuple[NDArray[np.int16], Codes]:
    """Return the heights and the DAC codes, both int16 (samples, channels), of a profile under a moving hand.

    `decoded`: int16, every packet; `delay_samples`: the decoder's. `positions`: time in us and place in nm, each
    there when it is needed; `start_us`: time of the first DAC sample. Bit for bit what a
    controller with this actuator puts out.
    """
    assert header.samples is not None, "a profile has a length"
    profile = Profile(header.rate_hz, header.samples, header.channels, actuator.dac_rate_hz)
    profile.load(decoded[delay_samples:])
    heights = np.empty((samples, header.channels), np.int16)
    waiting = list(reversed(positions))
    for number in range(samples):
        time_us = start_us + number * 1_000_000 // actuator.dac_rate_hz
        while waiting and waiting[-1][0] <= time_us:
            profile.position(*waiting.pop())
        heights[number] = profile.render([max(0, time_us - HAND_DELAY_US)])[0]
    output = rendered(header, actuator)
    drive = Drive(output, actuator, compensation)
    return heights, Dac(output, actuator, gain, compensation).play(drive.push(heights))
