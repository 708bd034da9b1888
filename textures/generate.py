"""Makes textures from physical models, seeded: gratings, ridges, rough surfaces, wood, stick-slip and taps.

Every generator takes the speed of the hand in mm/s: one number, or an array (n,) with one speed per sample, negative
where the hand moves back. Equal arguments give equal recordings. All raise TextureError for values out of range.
"""

from collections.abc import Callable

import numpy as np

from vibrocast.textures.profiles import Profile
from vibrocast.textures.recording import Recording, Signal, TextureError

HandSpeed = float | Signal

MAX_SAMPLES = 20_000_000
BAND = 0.45  # of the sample rate: the highest frequency of a sweep at its greatest speed
POINTS_PER_WAVE = 8  # of the shortest wave on a surface; cubic splines lie between the points
MAX_HARMONIC = 99


def varying_speed(
    seconds: float, rate_hz: float, mean_mm_s: float = 50.0, variation: float = 0.5, period_s: float = 1.0
) -> Signal:
    """Return mean * (1 + variation * sin(2 pi t / period)) in mm/s, float64 (n,): a hand that speeds up and slows down.

    A `variation` above one moves the hand back and forth.
    """
    _check_positive(period_s=period_s)
    time_s = np.arange(_sample_count(seconds, rate_hz)) / rate_hz
    return mean_mm_s * (1 + variation * np.sin(2 * np.pi * time_s / period_s))


def grating(
    seed: int = 0,
    seconds: float = 4.0,
    hand_speed_mm_s: HandSpeed = 50.0,
    rate_hz: float = 2800.0,
    pitch_mm: float = 1.0,
    height_um: float = 30.0,
    slope_fraction: float = 0.2,
) -> Recording:
    """Return the height, in um, under a probe that sweeps over a periodic grating of trapezoid ridges.

    `height_um`: height of a ridge. `slope_fraction`: part of the pitch that each flank takes (0.5: a triangle). The
    seed sets the phase. The result is the sum of the wave's Fourier series below BAND * rate_hz, so nothing aliases.
    """
    _check_positive(pitch_mm=pitch_mm, height_um=height_um, slope_fraction=slope_fraction)
    if slope_fraction > 0.5:
        raise TextureError(
            f"slope_fraction {slope_fraction}: two flanks of more than half a pitch do not fit; give at most 0.5"
        )
    position_mm, min_wave_mm = _sweep(seconds, hand_speed_mm_s, rate_hz, pitch_mm)
    phase = 2 * np.pi * (position_mm / pitch_mm + _random(seed).uniform())
    height = np.zeros(len(position_mm))
    for order in range(1, min(int(pitch_mm / min_wave_mm), MAX_HARMONIC) + 1, 2):
        # A square wave, 2 / (pi k), averaged over the width of a flank; np.sinc(x) = sin(pi x) / (pi x).
        height += height_um * 2 / (np.pi * order) * np.sinc(order * slope_fraction) * np.sin(order * phase)
    return Recording(height.reshape(-1, 1), rate_hz, "um", "grating")


def ridges(
    seed: int = 0,
    seconds: float = 4.0,
    hand_speed_mm_s: HandSpeed = 50.0,
    rate_hz: float = 2800.0,
    pitch_mm: float = 1.5,
    jitter: float = 0.3,
    width_mm: float = 0.15,
    height_um: float = 30.0,
) -> Recording:
    """Return the height, in um, under a probe that sweeps over rounded ridges at irregular distances.

    Ridges are Gaussian with standard deviation `width_mm`, or wider if rate and speed cannot show such detail. Their
    distances are pitch * (1 + jitter * uniform(-1, 1)), jitter 0 to 1, their heights height_um * uniform(0.5, 1). The
    mean is removed.
    """
    from scipy.ndimage import gaussian_filter1d

    _check_positive(pitch_mm=pitch_mm, width_mm=width_mm, height_um=height_um)
    position_mm, min_wave_mm = _sweep(seconds, hand_speed_mm_s, rate_hz, pitch_mm)
    width_mm = max(width_mm, min_wave_mm / 2)  # the shortest wave is then 43 dB down
    spacing_mm = width_mm / POINTS_PER_WAVE
    random = _random(seed)
    length_mm = float(np.ptp(position_mm)) + 8 * width_mm
    centres_mm = np.cumsum(_jittered(random, pitch_mm, jitter, length_mm))
    centres_mm = centres_mm[centres_mm < length_mm]
    heights_um = height_um * random.uniform(0.5, 1, len(centres_mm))
    points = int(length_mm / spacing_mm) + POINTS_PER_WAVE
    peaks = np.bincount((centres_mm / spacing_mm).astype(int), heights_um, points)
    surface = gaussian_filter1d(peaks, POINTS_PER_WAVE) * (2 * np.pi) ** 0.5 * POINTS_PER_WAVE
    height = _heights_under(surface, spacing_mm, position_mm)
    return Recording(height - height.mean(), rate_hz, "um", "ridges")


def rough(
    seed: int = 0,
    seconds: float = 4.0,
    hand_speed_mm_s: HandSpeed = 50.0,
    rate_hz: float = 2800.0,
    hurst: float = 0.7,
    roll_off_mm: float = 1.0,
    rms_um: float = 8.0,
) -> Recording:
    """Return the height, in um, under a probe that sweeps over a self-affine rough surface; see `rough_profile`.

    The surface has no waves that would exceed BAND * rate_hz at the greatest speed.
    """
    _check_positive(rms_um=rms_um)
    position_mm, min_wave_mm = _sweep(seconds, hand_speed_mm_s, rate_hz)
    spacing_mm = min_wave_mm / POINTS_PER_WAVE
    length_mm = float(np.ptp(position_mm))
    surface = _self_affine_surface(_random(seed), length_mm, spacing_mm, min_wave_mm, hurst, roll_off_mm)
    return Recording(_heights_under(rms_um * surface, spacing_mm, position_mm), rate_hz, "um", "rough")


def rough_profile(
    seed: int = 0,
    length_mm: float = 10.0,
    spacing_um: float = 2.0,
    hurst: float = 0.7,
    roll_off_mm: float = 1.0,
    rms_um: float = 8.0,
) -> Profile:
    """Return a random height profile of a self-affine surface: Gaussian heights with a given spectrum.

    Over the wavenumber q = 1 / wavelength, the power spectral density is constant up to 1 / roll_off_mm and falls as
    q^-(1 + 2 hurst) above, 0 < hurst < 1: B. Persson et al., "On the nature of surface roughness", J. Phys.: Condens.
    Matter 17 (2005) R1. For one dimension: T. Jacobs, T. Junge, L. Pastewka, "Quantitative characterization of surface
    topography using spectral analysis", Surf. Topogr. 5 (2017) 013001.
    """
    _check_positive(length_mm=length_mm, spacing_um=spacing_um, rms_um=rms_um)
    spacing_mm = spacing_um / 1000
    if length_mm / spacing_mm > MAX_SAMPLES:
        raise TextureError(f"length_mm {length_mm}: more than {MAX_SAMPLES} heights; shorten it or widen the spacing")
    surface = _self_affine_surface(_random(seed), length_mm, spacing_mm, 2 * spacing_mm, hurst, roll_off_mm)
    return Profile(rms_um * surface[: round(length_mm / spacing_mm) + 1], spacing_um, "rough profile")


def wood(
    seed: int = 0,
    seconds: float = 4.0,
    hand_speed_mm_s: HandSpeed = 50.0,
    rate_hz: float = 2800.0,
    pitch_mm: float = 1.2,
    grain_um: float = 12.0,
    rms_um: float = 3.0,
    resonance_hz: float = 220.0,
    damping_ratio: float = 0.3,
) -> Recording:
    """Return the acceleration, in m/s^2, of a stylus dragged across the grain of wood.

    The tip follows `wood_surface`. The stylus is a mass on a spring and damper whose foot is the tip: X/H = (2 d w s +
    w^2) / (s^2 + 2 d w s + w^2) with w = 2 pi resonance_hz, d = damping_ratio (S. Rao, "Mechanical Vibrations",
    response to the motion of the base). The bilinear transform of it is then differenced twice.
    """
    from scipy.signal import bilinear, lfilter

    _check_positive(resonance_hz=resonance_hz, damping_ratio=damping_ratio)
    if resonance_hz > BAND * rate_hz:
        raise TextureError(f"resonance_hz {resonance_hz}: it must be at most {BAND} of the sample rate")
    height_m = 1e-6 * wood_surface(seed, seconds, hand_speed_mm_s, rate_hz, pitch_mm, grain_um, rms_um).samples
    angular = 2 * np.pi * resonance_hz
    damping = 2 * damping_ratio * angular
    numerator, denominator = bilinear([damping, angular**2], [1, damping, angular**2], rate_hz)
    stylus_m = lfilter(numerator, denominator, height_m - height_m[0], axis=0)
    acceleration = np.diff(stylus_m, n=2, axis=0, prepend=stylus_m[[0, 0]]) * rate_hz**2
    return Recording(acceleration, rate_hz, "m/s^2", "wood")


def wood_surface(
    seed: int = 0,
    seconds: float = 4.0,
    hand_speed_mm_s: HandSpeed = 50.0,
    rate_hz: float = 2800.0,
    pitch_mm: float = 1.2,
    grain_um: float = 12.0,
    rms_um: float = 3.0,
) -> Recording:
    """Return the height, in um, under a probe that sweeps across the grain of wood.

    The grain is irregular ridges, `grain_um` high, on a rough surface of Hurst exponent 0.6 and `rms_um`.
    """
    surface = rough(seed, seconds, hand_speed_mm_s, rate_hz, 0.6, pitch_mm, rms_um)
    grain = ridges(seed, seconds, hand_speed_mm_s, rate_hz, pitch_mm, 0.6, 0.1, grain_um)
    return Recording(surface.samples + grain.samples, rate_hz, "um", "wood surface")


def stick_slip(
    seed: int = 0,
    seconds: float = 4.0,
    hand_speed_mm_s: HandSpeed = 50.0,
    rate_hz: float = 2800.0,
    slip_mm: float = 0.4,
    jitter: float = 0.2,
    natural_hz: float = 300.0,
    height_um: float = 40.0,
) -> Recording:
    """Return the deflection, in um, of a fingertip that repeatedly sticks to a surface and slips.

    A slider on a spring: while it sticks, the deflection grows with the path of the hand. After a path of slip_mm * (1
    + jitter * uniform(-1, 1)), jitter 0 to 1, it slips: the deflection falls by that path along half a cosine of the
    natural period (E. Rabinowicz, "Friction and Wear of Materials" (1965), chapter on stick-slip, for constant friction
    during the slip). It is scaled so that a slip of `slip_mm` falls by `height_um`; the mean is removed.
    """
    from scipy.signal import fftconvolve

    _check_positive(slip_mm=slip_mm, natural_hz=natural_hz, height_um=height_um)
    _sweep(seconds, hand_speed_mm_s, rate_hz, slip_mm)
    count = _sample_count(seconds, rate_hz)
    way_mm = np.cumsum(np.broadcast_to(np.abs(hand_speed_mm_s), count)) / rate_hz
    slips_mm = _jittered(_random(seed), slip_mm, jitter, way_mm[-1])
    slip_samples = np.searchsorted(way_mm, np.cumsum(slips_mm))
    slipped = slip_samples < count
    falls_mm = np.bincount(slip_samples[slipped], slips_mm[slipped], count)
    half_period = max(2, round(rate_hz / (2 * natural_hz)))
    slope = np.sin(np.pi * (np.arange(min(half_period, count)) + 0.5) / half_period)  # the slope of half a cosine
    fallen_mm = np.cumsum(fftconvolve(falls_mm, slope / slope.sum())[:count])
    deflection = (way_mm - fallen_mm) * height_um / slip_mm
    return Recording((deflection - deflection.mean()).reshape(-1, 1), rate_hz, "um", "stick-slip")


def taps(
    seed: int = 0,
    seconds: float = 4.0,
    hand_speed_mm_s: HandSpeed = 50.0,
    rate_hz: float = 2800.0,
    interval_s: float = 0.4,
    jitter: float = 0.2,
    frequency_hz: float = 200.0,
    decay_per_s: float = 60.0,
    peak_m_s2: float = 15.0,
) -> Recording:
    """Return the acceleration, in m/s^2, of a tool that taps on a surface.

    Each tap is a decaying sine A exp(-B t) sin(w t), where A is proportional to the hand's speed at impact: A. Okamura,
    M. Cutkosky, J. Dennerlein, "Reality-based models for vibration feedback in virtual environments", IEEE/ASME Trans.
    Mechatronics 6 (2001) 245. Here A is `peak_m_s2` at 50 mm/s. That paper fits frequency and decay to materials; the
    defaults are a hard tip on wood. Taps follow each other after interval * (1 + jitter * uniform(-1, 1)), jitter 0 to
    1.
    """
    from scipy.signal import fftconvolve

    _check_positive(interval_s=interval_s, frequency_hz=frequency_hz, decay_per_s=decay_per_s, peak_m_s2=peak_m_s2)
    if frequency_hz > BAND * rate_hz or interval_s * rate_hz < 1:
        raise TextureError(
            f"taps of {frequency_hz} Hz every {interval_s} s cannot be shown at {rate_hz} Hz; give a higher rate"
        )
    _sweep(seconds, hand_speed_mm_s, rate_hz)
    count = _sample_count(seconds, rate_hz)
    intervals_s = _jittered(_random(seed), interval_s, jitter, seconds)
    impacts = (np.cumsum(intervals_s) * rate_hz - interval_s * rate_hz / 2).astype(int)
    impacts = impacts[(impacts >= 0) & (impacts < count)]
    speeds_mm_s = np.broadcast_to(np.abs(hand_speed_mm_s), count)[impacts]
    amplitudes = np.bincount(impacts, peak_m_s2 / 50 * speeds_mm_s, count)
    ringing_samples = min(count, int(np.log(1e6) / decay_per_s * rate_hz) + 1)  # until 120 dB down
    time_s = np.arange(ringing_samples) / rate_hz
    tap = np.exp(-decay_per_s * time_s) * np.sin(2 * np.pi * frequency_hz * time_s)
    return Recording(fftconvolve(amplitudes, tap)[:count].reshape(-1, 1), rate_hz, "m/s^2", "taps")


GENERATORS: dict[str, Callable[..., Recording]] = {
    "grating": grating,
    "ridges": ridges,
    "rough": rough,
    "stick-slip": stick_slip,
    "taps": taps,
    "wood": wood,
}
SURFACES: dict[str, Callable[..., Recording]] = {
    "grating": grating,
    "ridges": ridges,
    "rough": rough,
    "wood": wood_surface,
}


def surface_profile(
    kind: str, seed: int = 0, seconds: float = 4.0, hand_speed_mm_s: float = 50.0, rate_hz: float = 2800.0
) -> Profile:
    """Return the surface over which a generator of SURFACES sweeps at one speed: a height every speed / rate."""
    if kind not in SURFACES:
        raise TextureError(f"{kind}: no generator of a height profile; choose one of {', '.join(SURFACES)}")
    recording = SURFACES[kind](seed, seconds, hand_speed_mm_s, rate_hz)
    return Profile(recording.samples[:, 0], 1000 * hand_speed_mm_s / rate_hz, kind)


def _check_positive(**values: float) -> None:
    for name, value in values.items():
        if not 0 < value < np.inf:
            raise TextureError(f"{name} {value}: it must be positive")


def _random(seed: int) -> np.random.Generator:
    if seed < 0:
        raise TextureError(f"seed {seed}: it must not be negative")
    return np.random.default_rng(seed)


def _jittered(random: np.random.Generator, mean: float, jitter: float, total: float) -> Signal:
    """Return intervals around a mean, each off by at most `jitter` of it, whose sum exceeds a total."""
    if not 0 <= jitter <= 1:
        raise TextureError(f"jitter {jitter}: it must be 0 to 1")
    mean_count = total / mean
    return mean * (1 + jitter * random.uniform(-1, 1, int(mean_count + 4 * mean_count**0.5) + 4))


def _sample_count(seconds: float, rate_hz: float) -> int:
    _check_positive(seconds=seconds, rate_hz=rate_hz)
    if not 1 <= seconds * rate_hz <= MAX_SAMPLES:
        raise TextureError(f"{seconds} s at {rate_hz} Hz: a recording has 1 to {MAX_SAMPLES} samples")
    return round(seconds * rate_hz)


def _sweep(
    seconds: float, hand_speed_mm_s: HandSpeed, rate_hz: float, pitch_mm: float = np.inf
) -> tuple[Signal, float]:
    """Return the hand's position, in mm, float64 (n,) from 0 up, and the shortest wave that the sweep can show.

    Raises TextureError if `pitch_mm` is shorter than that wave.
    """
    count = _sample_count(seconds, rate_hz)
    speed_mm_s = np.asarray(hand_speed_mm_s, np.float64)
    if speed_mm_s.shape not in ((), (count,)):
        raise TextureError(f"hand speed of shape {speed_mm_s.shape}: give one number or {count} of them")
    max_speed_mm_s = float(np.max(np.abs(speed_mm_s)))
    if not 0 < max_speed_mm_s < np.inf:
        raise TextureError("hand speed: it must be finite, and positive somewhere")
    min_wave_mm = max_speed_mm_s / (BAND * rate_hz)
    if pitch_mm < min_wave_mm:
        raise TextureError(
            f"a pitch of {pitch_mm} mm cannot be shown at {max_speed_mm_s:g} mm/s and {rate_hz:g} Hz; "
            f"it must be at least {min_wave_mm:.3g} mm"
        )
    position_mm = np.cumsum(np.broadcast_to(speed_mm_s, count)) / rate_hz
    return position_mm - position_mm.min(), min_wave_mm


def _heights_under(surface: Signal, spacing_mm: float, position_mm: Signal) -> Signal:
    """Return the surface's height at each position, (n, 1), by cubic splines."""
    from scipy.ndimage import map_coordinates

    heights: Signal = map_coordinates(surface, [position_mm / spacing_mm], order=3, mode="nearest")
    return heights.reshape(-1, 1)


def _self_affine_surface(
    random: np.random.Generator,
    length_mm: float,
    spacing_mm: float,
    min_wave_mm: float,
    hurst: float,
    roll_off_mm: float,
) -> Signal:
    """Return heights (n,), rms 1, at least `length_mm` long; each Fourier coefficient has a normal density."""
    from scipy.fft import irfft, next_fast_len, rfftfreq

    _check_positive(roll_off_mm=roll_off_mm)
    if not 0 < hurst < 1:
        raise TextureError(f"hurst {hurst}: it must lie between 0 and 1")
    count = next_fast_len(int(max(length_mm, 16 * min_wave_mm) / spacing_mm) + 2, real=True)
    wavenumber = rfftfreq(count, spacing_mm)
    density = np.maximum(wavenumber * roll_off_mm, 1) ** -(1 + 2 * hurst)
    density[(wavenumber == 0) | (wavenumber > 1 / min_wave_mm)] = 0
    phases_and_sizes = random.standard_normal(len(density)) + 1j * random.standard_normal(len(density))
    surface: Signal = irfft(np.sqrt(density) * phases_and_sizes, count)
    surface /= surface.std()
    return surface
