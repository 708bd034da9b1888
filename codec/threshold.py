"""The detection threshold b(F) of vibration at the fingertip: replaceable data, in displacement or acceleration."""

import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vibrocast.codec.interface import Codec, CodecError, Setting
from vibrocast.device_protocol.coded_stream import PROFILE_UNIT

TACTILE_BAND_HZ = (40.0, 800.0)
"""The Pacinian channel: S. J. Bolanowski et al., "Four channels mediate the mechanical aspects of touch", 1988."""
BLOCK_S = 0.2
"""Components are 1 / BLOCK_S = 5 Hz apart, as in the DCT paper. The skin sums vibration over about this time (Verrillo,
"Temporal summation in vibrotactile sensitivity", JASA 37, 1965)."""
MIN_HZ, MAX_HZ = 10.0, 1000.0
"""The band in which textures are felt. Below it, the hand moves as a whole; above it, no channel of touch answers."""
BANDS_PER_OCTAVE = 12
PHYSICAL_UNITS = ("um", "m/s^2")
"""The units of signals over time in which it is known what can be felt."""
SKIN_MIN_HZ = 20.0
"""The lowest frequency that counts at the skin: controllers remove what lies below (output.rendering.HIGH_PASS_HZ)."""
_BLOCKS_AT_ONCE = 256
_FILTER_S = 0.3
_FILTER_POINTS = 8193
DATA = Path(__file__).parent / "data"
DETECTION_THRESHOLD = DATA / "detection_threshold.csv"
MASKING = DATA / "masking.csv"
_SITE = "detection_threshold_"
NODES = (0.0, 1 / 32, 1 / 16, 1 / 8, 1 / 4, 1 / 2, 1.0)
"""The frequencies of a shape, in parts of half the rate. Between them it is linear over frequency."""
MAX_OCTAVES = 2.7
SHAPE, FLAT = "shape", "flat"
"""The parameter, of codecs that have shapes, and its value for none."""
DEFAULT_TOUCH = 0.25
"""The strength of the shape for signals in a physical unit; docs/explanation/decisions/mdct.md says why."""
_MOST_OVER_250_HZ_DB = 10.0
_SPQI_NODE = NODES.index(1 / 16)
_SPQI_DB = 6.0
_OCTAVE_DB = 20 * math.log10(2)


def read_threshold(path: Path = DETECTION_THRESHOLD) -> NDArray[np.float64]:
    """Return rows of frequency in Hz, rising, and least felt displacement in dB re 1 um peak: float64 (n, 2).

    A file states its source in lines that begin with #. Raises CodecError.
    """
    try:
        with path.open(newline="", encoding="utf-8") as file:
            rows = list(csv.reader(line for line in file if not line.startswith("#")))
        values = np.array(rows[1:], dtype=np.float64)
    except (OSError, ValueError, csv.Error) as error:
        raise CodecError(
            f"{str(path)!r} cannot be read as a detection threshold ({error}); give rows of Hz and dB"
        ) from error
    if not (
        values.ndim == 2
        and values.shape[1] == 2
        and np.all(np.isfinite(values))
        and values[0, 0] > 0
        and np.all(np.diff(values[:, 0]) > 0)
    ):
        raise CodecError(
            f"{path} is no detection threshold; write rows of a frequency in Hz, rising, and a level in dB"
        )
    return values


def sites() -> dict[str, Path]:
    """Return the files of the detection thresholds that ship, by the body site and contactor in their names."""
    others = {path.stem.removeprefix(_SITE).replace("_", "-"): path for path in sorted(DATA.glob(f"{_SITE}*.csv"))}
    return {"fingertip-large": DETECTION_THRESHOLD, **others}


def threshold_file(name: str | None, folder: Path) -> Path:
    """Return the file of a detection threshold: one of `sites`, or a path from a folder on; None = the fingertip's."""
    return DETECTION_THRESHOLD if name is None else sites().get(name, folder / name)


def band_parts(
    bins: int, spacing_hz: float, lower_hz: NDArray[np.float64], upper_hz: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return which part of each bin of a spectrum lies in each band: float64 (bins, bands).

    The bins are `spacing_hz` apart, the first at 0 Hz; a bin's power lies evenly between its neighbours'. A power
    spectrum (..., bins) @ these parts is the power in the bands.
    """
    bins_hz = spacing_hz * np.arange(bins)[:, None]
    within_hz = np.minimum(bins_hz + spacing_hz / 2, upper_hz) - np.maximum(bins_hz - spacing_hz / 2, lower_hz)
    parts: NDArray[np.float64] = np.maximum(within_hz, 0) / spacing_hz
    return parts


def threshold_amplitude(rows: NDArray[np.float64], frequency_hz: NDArray[np.float64], unit: str) -> NDArray[np.float64]:
    """Return the least felt amplitude, in `unit` ("um" or "m/s^2"), of vibrations at each frequency.

    `rows` as from `read_threshold`. Between them the level is linear over log frequency; beyond them it is that of the
    nearest row. An amplitude a of displacement is (2 pi F)^2 a of acceleration. Raises CodecError for a signal without
    a physical unit.
    """
    if unit == PROFILE_UNIT:
        raise CodecError(
            "the detection threshold needs a signal over time, and this stream is spatial; give a touch of 0"
        )
    if unit not in PHYSICAL_UNITS:
        raise CodecError(
            "the detection threshold is a displacement, and this signal is relative to full scale",
            action="give `unit` and `full_scale`, or a touch of 0",
            parameter=("unit", "full_scale"),
        )
    nearest_hz = np.clip(frequency_hz, rows[0, 0], rows[-1, 0])
    displacement_um = 10 ** (np.interp(np.log(nearest_hz), np.log(rows[:, 0]), rows[:, 1]) / 20)
    if unit == "um":
        return displacement_um
    return 1e-6 * displacement_um * (2 * np.pi * frequency_hz) ** 2


def masked_part() -> float:
    """Return the level of the strongest error that a vibration of level 1 hides in the same third octave and block.

    An error that is not correlated with it raises its level by the factor sqrt(1 + part^2). That is felt from
    1 + Weber fraction on (data/masking.csv, which also has its sources). Raises CodecError.
    """
    try:
        with MASKING.open(newline="", encoding="utf-8") as file:
            rows = dict(list(csv.reader(line for line in file if not line.startswith("#")))[1:])
        fraction = float(rows["weber_fraction"])
    except (OSError, ValueError, KeyError, csv.Error) as error:
        raise CodecError(f"{str(MASKING)!r} cannot be read ({error}); give rows of a quantity and its value") from error
    return math.sqrt((1 + fraction) ** 2 - 1)


def over_threshold_db(
    samples: NDArray[np.float64],
    rate_hz: float,
    threshold: NDArray[np.float64],
    masker: NDArray[np.float64] | None = None,
    unit: str = "um",
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return frequencies, and the loudest level of the third octave about each, in dB re the detection threshold.

    `samples`: float64 (n, channels) in `unit`. `threshold`: rows as from `read_threshold`. Hann windows of BLOCK_S
    overlap by half. The amplitude is that of a sine with the power of all components of the third octave (IEC 61260:
    edges at 2^(+-1/6)), or of the nearest one if that is more. So noise counts as the skin sums it. The loudest block
    and channel count, because a finger feels one block.

    `masker`: a vibration of the same shape that hides errors, None = none. Where it raises the threshold of a third
    octave in a block, to `masked_part` of its own level, levels are relative to the raised one. Raises CodecError for a
    unit that is not physical.
    """
    block = max(4, round(BLOCK_S * rate_hz))
    window = np.hanning(block + 1)[:-1]
    blocks = _overlapping(samples, block)
    maskers = None if masker is None else _overlapping(masker, block)
    spacing_hz = rate_hz / block
    highest_hz = min(MAX_HZ, rate_hz / 2 / 2 ** (1 / 6))
    lowest_hz = max(MIN_HZ, spacing_hz)
    # The same middles at every rate, so that results at different rates can be compared.
    steps = np.arange(1 + math.floor(BANDS_PER_OCTAVE * math.log2(MAX_HZ / MIN_HZ)))
    middle_hz = MIN_HZ * 2 ** (steps / BANDS_PER_OCTAVE)
    middle_hz = middle_hz[(middle_hz >= lowest_hz) & (middle_hz <= highest_hz)]
    parts = band_parts(block // 2 + 1, spacing_hz, middle_hz / 2 ** (1 / 6), middle_hz * 2 ** (1 / 6))
    nearest = np.rint(middle_hz / spacing_hz).astype(int)

    def band_power(some: NDArray[np.float64]) -> NDArray[np.float64]:
        # (blocks, channels, components) of power as mean square.
        power = 2 * np.abs(np.fft.rfft(some * window)) ** 2 / (block * np.sum(window**2))
        return np.asarray(np.maximum(power @ parts, power[..., nearest]))

    felt = np.square(threshold_amplitude(threshold, middle_hz, unit)) / 2
    hidden = 0.0 if maskers is None else masked_part() ** 2
    loudest = np.full(len(middle_hz), 1e-60)
    for start in range(0, len(blocks), _BLOCKS_AT_ONCE):  # to limit memory for long signals
        here = slice(start, start + _BLOCKS_AT_ONCE)
        least = felt if maskers is None else np.maximum(felt, hidden * band_power(maskers[here]))
        loudest = np.maximum(loudest, np.max(band_power(blocks[here]) / least, axis=(0, 1), initial=0.0))
    return middle_hz, 10 * np.log10(loudest)


@dataclass(frozen=True)
class FeltError:
    """The third octave in which an error exceeds the detection threshold most; below 0 dB nobody feels it.

    `level_db`: of the error there, in its loudest block and channel. `texture_db`: the same of the texture there. Both
    are as in `over_threshold_db`, without masking.
    """

    level_db: float
    frequency_hz: float
    texture_db: float


def felt_error(
    reference: NDArray[np.float64], decoded: NDArray[np.float64], rate_hz: float, unit: str
) -> FeltError | None:
    """Return where the error of `decoded` is felt most, from SKIN_MIN_HZ on; both (n, channels) in a physical unit.

    None where there is no error, and where the rate has room for no third octave.
    """
    threshold = read_threshold()
    frequencies_hz, levels_db = over_threshold_db(reference - decoded, rate_hz, threshold, unit=unit)
    within = frequencies_hz >= SKIN_MIN_HZ
    if not np.any(within) or np.array_equal(reference, decoded):
        return None
    worst = int(np.argmax(np.where(within, levels_db, -np.inf)))
    _, texture_db = over_threshold_db(reference, rate_hz, threshold, unit=unit)
    return FeltError(float(levels_db[worst]), float(frequencies_hz[worst]), float(texture_db[worst]))


def _overlapping(samples: NDArray[np.float64], block: int) -> NDArray[np.float64]:
    """Return blocks of samples (n, channels) that overlap by half, (blocks, channels, block).

    They reach into silence before and after, so that windows cover the very first and last sample too.
    """
    padded = np.pad(samples, ((block // 2, block), (0, 0)))
    return np.lib.stride_tricks.sliding_window_view(padded, block, axis=0)[:: max(1, block // 2)]


def skin_filter(rate_hz: float, unit: str, threshold: NDArray[np.float64] | None, samples: int) -> NDArray[np.float64]:
    """Return an FIR filter of odd length: from samples in `unit`, "um" or "m/s^2", to displacement, 20 to 1000 Hz.

    The displacement is in um or, with a `threshold` (rows as from `read_threshold`), in parts of the least that is felt
    at its frequency. Acceleration is divided by (2 pi f)^2. The filter has linear phase and lasts 0.3 s, or half of
    the `samples` that it is for if that is shorter. Raises CodecError for a unit that is not physical.
    """
    from scipy import signal

    frequency_hz: NDArray[np.float64] = np.linspace(0, rate_hz / 2, _FILTER_POINTS)
    within = (frequency_hz >= SKIN_MIN_HZ) & (frequency_hz <= MAX_HZ)
    rows = np.array([[1.0, 0.0]]) if threshold is None else threshold
    gain = np.zeros(_FILTER_POINTS)
    gain[within] = 1 / threshold_amplitude(rows, frequency_hz[within], unit)
    half = max(1, min(round(_FILTER_S * rate_hz), samples // 2) // 2)
    return np.asarray(signal.firwin2(2 * half + 1, frequency_hz, gain, nfreqs=2**15 + 1, fs=rate_hz))


def filtered(samples: NDArray[np.float64], taps: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return samples (n,) or (n, channels) through an FIR filter (m,): as many, late by half the filter.

    A cut at the end of the signal adds nothing before that end.
    """
    from scipy import signal

    shaped = taps if samples.ndim == 1 else taps[:, None]
    return np.asarray(signal.oaconvolve(samples, shaped, axes=0)[: len(samples)])


def skin_power(
    samples: NDArray[np.float64], rate_hz: float, unit: str, threshold: NDArray[np.float64] | None = None
) -> NDArray[np.float64]:
    """Return the energy of samples (n, channels) through `skin_filter`, the sum of squares: float64 (channels,).

    Raises CodecError for a unit that is not physical.
    """
    taps = skin_filter(rate_hz, unit, threshold, len(samples))
    power: NDArray[np.float64] = np.sum(np.square(filtered(samples, taps)), axis=0)
    return power


def skin_snr_db(
    reference: NDArray[np.float64],
    decoded: NDArray[np.float64],
    rate_hz: float,
    unit: str,
    threshold: NDArray[np.float64] | None = None,
) -> float | None:
    """Return the SNR in dB of two arrays (n, channels) as displacement: the mean over channels that have one.

    The other parameters are those of `skin_power`. None where no channel has a signal and an error.
    """
    powers = (skin_power(each, rate_hz, unit, threshold) for each in (reference, reference - decoded))
    ratios = [10 * math.log10(x / e) for x, e in zip(*powers, strict=True) if x > 0 and e > 0]
    return sum(ratios) / len(ratios) if ratios else None


def touch_shape(touch: float, rate_hz: float, unit: str) -> tuple[float, ...]:
    """Return the shape of a strength from 0, flat, to 1: octaves of the step at NODES, at least 0.

    At strength 1, steps are proportional to the detection threshold in the stream's unit, from its value at 250 Hz up
    to 10 dB above. So the error is finer where touch is sensitive. At 1/16 of half the rate they are 6 dB finer: SPQI
    weighs errors most there at any rate, because the axis of its threshold does not follow the rate. Other strengths
    scale the octaves. Raises CodecError for a strength beyond 0 to 1, or a unit that is not physical.
    """
    if not 0 <= touch <= 1:
        raise CodecError(f"a strength of touch of {touch:g} is not possible; give 0, flat, to 1")
    nodes_hz = np.maximum(np.array(NODES) * rate_hz / 2, MIN_HZ)
    at_nodes, at_250_hz = (threshold_amplitude(read_threshold(), each, unit) for each in (nodes_hz, np.array([250.0])))
    level_db = np.clip(20 * np.log10(at_nodes / at_250_hz), 0, _MOST_OVER_250_HZ_DB)
    level_db[_SPQI_NODE] -= _SPQI_DB
    return tuple((touch * (level_db - level_db.min()) / _OCTAVE_DB).tolist())


def shape_text(octaves: Sequence[float]) -> str:
    """Return a shape as the value of a codec's parameter."""
    return "/".join(f"{each:.4g}" for each in octaves)


def parsed_shape(text: str) -> tuple[float, ...] | None:
    """Return the octaves of a parameter's value, None for FLAT. Raises CodecError."""
    if text == FLAT:
        return None
    try:
        octaves = tuple(float(each) for each in text.split("/"))
    except ValueError:
        octaves = ()
    if len(octaves) != len(NODES) or not all(math.isfinite(each) and 0 <= each <= MAX_OCTAVES for each in octaves):
        raise CodecError(
            f"shape is {text!r}; write {FLAT}, or {len(NODES)} octaves from 0 to {MAX_OCTAVES}, divided by slashes"
        )
    return octaves


def shape_setting(
    codec: Codec, touch: float | None, rate_hz: float, unit: str, setting: Setting | None = None
) -> Setting:
    """Return the part of a codec's setting that serves touch, with a strength from 0, flat, to 1.

    `touch`: None = the default where the codec has shapes and the unit is physical, else 0. `setting`: what else is
    given; a shape in it stands before the default. Raises CodecError as `touch_shape`, where both a strength
    and a shape are given, and for a strength above 0 of a codec without shapes.
    """
    has_shapes = SHAPE in codec.parameters
    given = has_shapes and SHAPE in (setting or {})
    if touch is None:
        touch = DEFAULT_TOUCH if has_shapes and not given and unit in PHYSICAL_UNITS else 0.0
    elif given:
        raise CodecError("a strength of touch and a shape are both given; give one of them")
    if touch == 0 or not has_shapes:
        if touch != 0:
            raise CodecError(f"{codec.name} cannot shape its error for touch; choose mdct, or a touch of 0")
        return {}
    return {SHAPE: shape_text(touch_shape(touch, rate_hz, unit))}
