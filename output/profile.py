"""Renders a height profile by the position of the hand, by vibrocast/profile.h: the same integers everywhere."""

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from vibrocast.device_protocol.coded_stream import StreamHeader
from vibrocast.firmware.native_core import Structure, ffi, library
from vibrocast.output.actuator import Actuator, Codes
from vibrocast.output.rendering import Dac, Drive

# Delay with which positions from a host are rendered, and time constant of each of the two low-passes that smooth them:
# vibrocast/profile.h.
HAND_DELAY_US = 20_000
HAND_SMOOTHING_US = 4_000


def min_samples(samples_per_metre: int, dac_rate_hz: int) -> int:
    """Return the fewest samples of a profile that such a DAC can render; 0 if it can render none.

    The period of every profile is a multiple of it; samples beyond that are left out.
    """
    return int(library().vc_profile_least_samples(samples_per_metre, dac_rate_hz))


def rendered(header: StreamHeader, actuator: Actuator) -> StreamHeader:
    """Return the header of the heights that are rendered from a profile: um, at the DAC's rate."""
    return replace(header, unit="um", rate_hz=actuator.dac_rate_hz)


class Profile:
    """The height under the hand at every DAC sample.

    First, load a profile of `samples` (at least `min_samples`) per channel. Then pass positions of the hand with their
    times; heights come out, in the profile's own integers.
    """

    def __init__(self, samples_per_metre: int, samples: int, channels: int, dac_rate_hz: int) -> None:
        self._channels = channels
        self._profile = Structure(library().vc_profile_size(samples, channels), "vc_profile *")
        library().vc_profile_init(self._profile.pointer, samples_per_metre, samples, channels, dac_rate_hz)

    def load(self, decoded: NDArray[np.int16]) -> None:
        """Take the next decoded samples, int16 (n, channels)."""
        decoded = np.ascontiguousarray(decoded)
        pointer = ffi.cast("int16_t *", decoded.ctypes.data)
        samples = len(decoded)
        while library().vc_profile_load(self._profile.pointer, pointer, samples):
            samples = 0

    def position(self, time_us: int, position_nm: int) -> bool:
        """Take the position of the hand at a time. It is dropped unless later than the last one and within 2^40 nm.

        Return whether it came too late: the hand had moved on, and was rendered at rest.
        """
        return bool(library().vc_profile_position(self._profile.pointer, time_us, position_nm))

    def render(self, times_us: Iterable[int]) -> NDArray[np.int16]:
        """Return the heights int16 (n, channels) at the times of consecutive DAC samples."""
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

    `decoded`: int16, every packet; `delay_samples`: the decoder's. `positions`: time in us and place in nm, each in
    time for its use; `start_us`: time of the first DAC sample. Bit for bit the output of a controller with this
    actuator.
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
