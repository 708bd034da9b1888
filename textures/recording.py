"""The recording that every loader and generator returns, the units that it may have, and their spellings."""

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vibrocast.errors import InputError

Signal = NDArray[np.float64]

UNITS = ("full scale", "m/s^2", "um")
MAX_CHANNELS = 16  # the most in one coded stream
MAX_MAGNITUDE = 1e30  # of a sample, in any unit; float32 holds it, and its square is finite
MIN_RATE_HZ, MAX_RATE_HZ = 0.01, 1e7  # beyond any texture: other rates come from a wrong unit or a damaged file

# Unit as people write it: the unit of UNITS that it becomes, and the factor. Standard gravity: CGPM 1901, exact.
INPUT_UNITS: dict[str, tuple[str, float]] = {
    "full scale": ("full scale", 1.0),
    "drive": ("full scale", 1.0),  # the numbers are the actuator's drive signal
    "m/s^2": ("m/s^2", 1.0),
    "mm/s^2": ("m/s^2", 1e-3),
    "g": ("m/s^2", 9.80665),
    "mg": ("m/s^2", 9.80665e-3),
    "nm": ("um", 1e-3),
    "um": ("um", 1.0),
    "mm": ("um", 1e3),
}
VOLTS = {"uV": 1e-6, "mV": 1e-3, "V": 1.0}
"""Units of a sensor's output, in V; its sensitivity turns them into one of UNITS."""
FILE_UNITS = (*INPUT_UNITS, *VOLTS)
"""Units of the numbers in a file."""
SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
"""Units of a column of times, in s."""

_SPELLINGS = {
    "full scale": ("full_scale",),
    "m/s^2": ("m/s2", "m/s²", "m/s**2", "m/s/s", "m_s2", "ms2", "ms^2", "ms-2", "m/sec^2", "m/sec2", "ms⁻²", "m·s⁻²"),
    "mm/s^2": ("mm/s2", "mm/s²", "mm/s**2", "mm/s/s", "mm_s2", "mm/sec^2"),
    "g": ("gs", "g0", "gn", "gravity", "gravities"),
    "mg": ("milli-g", "millig"),
    "um": ("µm", "μm", "micron", "microns"),  # micro sign and Greek mu
    "mm": ("millimetre", "millimetres", "millimeter", "millimeters"),
    "uV": ("µV", "μV", "microvolt", "microvolts"),
    "mV": ("millivolt", "millivolts"),
    "V": ("volt", "volts"),
    "s": ("sec", "secs", "second", "seconds"),
    "ms": ("msec", "msecs", "millis", "millisecond", "milliseconds"),
    "us": ("µs", "μs", "usec", "usecs", "micros", "microsecond", "microseconds"),
    "ns": ("nsec", "nsecs", "nanos", "nanosecond", "nanoseconds"),
}
SPELLINGS = {name: name for name in (*FILE_UNITS, *SECONDS)} | {
    other: name for name, others in _SPELLINGS.items() for other in others
}
"""The unit, one of FILE_UNITS and SECONDS, by each way to write it."""
_IN_ANY_CASE = {text.casefold(): unit for text, unit in SPELLINGS.items()}


class TextureError(InputError):
    """A file, option or parameter that cannot be used; the message says why and what to do."""


def unusable(path: Path | str, problem: str, action: str, *parameters: str) -> TextureError:
    """Return the error for a file. `parameters`: those of `textures.load` that the texts name."""
    return TextureError(f"{path}: {problem}", action=action, parameter=parameters)


def spelt(text: str) -> str | None:
    """Return the unit that a text means, as in SPELLINGS, in any case if it is not there; None for any other text."""
    return SPELLINGS.get(text) or _IN_ANY_CASE.get(text.casefold())


def known_unit(text: str, place: str, known: Collection[str] = INPUT_UNITS) -> str:
    """Return a unit as spelt in `known`. Raises TextureError, which names the `place`, for any other."""
    unit = spelt(text)
    if unit is None or unit not in known:
        raise TextureError(f"{place}: unknown unit {text!r}; known are {', '.join(known)}", parameter="unit")
    return unit


@dataclass(frozen=True, eq=False)
class Contents:
    """The samples of a file, and the facts that it states.

    `samples`: float64 (n, channels), as numbers in the file. `rate_hz`, `unit` (one of FILE_UNITS): None if the
    file does not state them. `full_scale`: the number that stands for full scale if the unit is "full scale"; None if
    the file's type of integers states none. `axes`, `notes`: as in Recording. `names`: of the channels, or none.
    """

    samples: Signal
    rate_hz: float | None
    unit: str | None
    full_scale: float | None = 1.0
    axes: tuple[str, ...] = ()
    names: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Recording:
    """A recorded or generated texture.

    Attributes:
        samples: float64 (n, channels) with n >= 1. Each channel drives one actuator.
        rate_hz: Sample rate in Hz.
        unit: "m/s^2" (acceleration), "um" (displacement) or "full scale".
        name: A name for people.
        axes: The axis of each channel, where the channels are the axes of one texture; empty otherwise.
        drive: Whether the samples are the actuator's drive signal, so that 1.0 in "full scale" is its full stroke.
        notes: What `load` inferred, left out or doubts, and how a clip was rendered, in sentences for people.

    Raises:
        TextureError: An attribute is none of these.
    """

    samples: Signal
    rate_hz: float
    unit: str
    name: str
    axes: tuple[str, ...] = ()
    drive: bool = False
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.samples.ndim != 2 or self.samples.dtype != np.float64:
            raise TextureError(f"{self.name}: samples must be float64 (n, channels)")
        if not self.samples.size:
            raise TextureError(f"{self.name}: holds no samples; give another file")
        if self.channels > MAX_CHANNELS:
            raise TextureError(
                f"{self.name}: {self.channels} channels, and at most {MAX_CHANNELS} can be played; "
                "rows must be samples and columns channels"
            )
        if self.axes and len(self.axes) != self.channels:
            raise TextureError(f"{self.name}: {len(self.axes)} axes for {self.channels} channels; name each channel's")
        check_rate(self.rate_hz, self.name)
        if self.unit not in UNITS:
            raise TextureError(f"{self.name}: unit {self.unit!r} is not one of {', '.join(UNITS)}")
        # An extreme is nan if any sample is. Finding it takes no memory; a mask of a day's recording would.
        if not (self.samples.min() >= -MAX_MAGNITUDE and self.samples.max() <= MAX_MAGNITUDE):
            usable = np.abs(self.samples) <= MAX_MAGNITUDE
            sample, channel = np.unravel_index(np.argmin(usable), usable.shape)
            raise TextureError(
                f"{self.name}: sample {sample} of channel {channel} is {self.samples[sample, channel]}; "
                f"remove or repair what is not a number of at most {MAX_MAGNITUDE:g}"
            )

    @property
    def channels(self) -> int:
        """The number of channels."""
        return int(self.samples.shape[1])

    @property
    def seconds(self) -> float:
        """The duration in s."""
        return len(self.samples) / self.rate_hz


def check_rate(rate_hz: float, name: str) -> None:
    """Raise TextureError, which names the recording, for a sample rate that no recording has."""
    if not MIN_RATE_HZ <= rate_hz <= MAX_RATE_HZ:
        raise TextureError(
            f"{name}: sample rate {rate_hz:g} Hz; it must be {MIN_RATE_HZ:g} to {MAX_RATE_HZ:g} Hz: correct the rate, "
            "the unit of the times, or the hand speed over a height profile"
        )
