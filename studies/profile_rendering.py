"""Renders a coded profile at several hand speeds: `python -m studies.profile_rendering --out docs/benchmarks`.

Writes OUT/profiles.png and OUT/profiles.csv: the rendered profile against the decoded one, resampled exactly, and its
cost on a Cortex-M4.
"""

import csv
import tempfile
from pathlib import Path

import click
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from studies.emulated_core import CORES, EmulatedCore, compile_core
from studies.page import OUT
from vibrocast.codec import profiles
from vibrocast.host import hand_playback as position_playback
from vibrocast.output import profile as rendering
from vibrocast.output.actuator import PIEZO_STACK

ROOT = Path(__file__).resolve().parents[1]
PROFILE = ROOT / "examples" / "leather_profile.csv"
SPEEDS_MM_S = (1, 5, 10, 20, 50, 100, 200, 300)
SHOWN_MM_S = (10, 50, 300)
BAND_PART = 0.15  # of the DAC's rate: vibrocast/profile.h
SETTLED_S, SECONDS, SHOWN_S = 0.1, 1.1, 0.08
POSITION_S = 0.004
_DAC_SAMPLES = 3000
_MEMORY, _DECODED, _HEIGHTS = 0x2000_0000, 0x6000_0000, 0x6008_0000


def resampled(
    period_um: NDArray[np.float64], places_m: NDArray[np.float64], samples_per_metre: int, highest_per_metre: float
) -> NDArray[np.float64]:
    """Return a repeated profile at any places, up to a spatial frequency, by its Fourier series: exact."""
    spectrum = np.fft.rfft(period_um) / len(period_um)
    length_m = len(period_um) / samples_per_metre
    heights = np.full(len(places_m), spectrum[0].real)
    for k in range(1, min(len(spectrum), int(highest_per_metre * length_m) + 1)):
        heights += 2 * (spectrum[k] * np.exp(2j * np.pi * k * places_m / length_m)).real
    return heights


def snr_db(rendered_um: NDArray[np.float64], exact_um: NDArray[np.float64]) -> float:
    """Return the SNR within 0.95 of the band: above it the rendering falls off, and is not meant to be exact."""
    window = np.blackman(len(exact_um))
    inside = np.fft.rfftfreq(len(exact_um)) < 0.95 * BAND_PART
    error, signal = (np.fft.rfft(values * window)[inside] for values in (rendered_um - exact_um, exact_um))
    return float(10 * np.log10(np.sum(np.abs(signal) ** 2) / np.sum(np.abs(error) ** 2)))


def cost(decoded: NDArray[np.int16], samples_per_metre: int) -> dict[str, float]:
    """Return instructions and cycles of a Cortex-M4 for a DAC sample at the costliest speed, for loading, and bytes."""
    functions = [f"vc_profile_{name}" for name in ("init", "load", "position", "render", "size", "begin")]
    with tempfile.TemporaryDirectory() as folder:
        core = EmulatedCore(compile_core(Path(folder) / "profile.elf", CORES["M4F"], functions), CORES["M4F"])
    rate_hz = PIEZO_STACK.dac_rate_hz
    core.call("vc_profile_init", _MEMORY, samples_per_metre, len(decoded), 1, rate_hz)
    core.write(_DECODED, decoded.astype("<i2").tobytes())
    core.clear()
    core.call("vc_profile_load", _MEMORY, _DECODED, len(decoded))
    loading = core.instructions
    core.clear()
    # A 64-bit argument takes an aligned pair of registers: r2 and r3, then the stack.
    for number in range(_DAC_SAMPLES):
        time_us = number * 1_000_000 // rate_hz
        if number % 6 == 0:
            core.call("vc_profile_position", _MEMORY, 0, time_us, 0, 200 * time_us, 0)
        core.call("vc_profile_render", _MEMORY, 0, time_us, 0, _HEIGHTS)
    return {
        "instructions_per_dac_sample": core.instructions / _DAC_SAMPLES,
        "cycles_per_dac_sample": core.cycles / _DAC_SAMPLES,
        "load_percent_of_168_MHz": 100 * core.cycles / _DAC_SAMPLES * rate_hz / CORES["M4F"].clock_hz,
        "instructions_to_load": float(loading),
        "bytes": float(core.call("vc_profile_size", len(decoded), 1)),
        "stack_bytes": float(core.stack_bytes),
    }


@click.command()
@OUT
def main(out: Path) -> None:
    """Render a coded profile at several hand speeds; write profiles.png and profiles.csv."""
    out.mkdir(parents=True, exist_ok=True)
    stream = profiles.encode(profiles.recording_of(PROFILE), snr_db=20.0).stream
    header, decoder, rate_hz = stream.header, stream.decoder(), PIEZO_STACK.dac_rate_hz
    integers, gain = stream.decode_integers(), header.gains[0] / 32768
    decoded = integers[decoder.delay_samples : decoder.delay_samples + stream.samples]
    period_um = decoded[:, 0].astype(np.float64) * gain
    time_s = np.arange(round(SECONDS * rate_hz)) / rate_hz
    late_s = (rendering.HAND_DELAY_US + 2 * rendering.HAND_SMOOTHING_US) / 1e6

    def rendered(movement: position_playback.Movement) -> NDArray[np.float64]:
        positions = [
            (round(1e6 * at_s), round(1e6 * at_mm))
            for at_s, at_mm in zip(movement.times_s, movement.positions_mm, strict=True)
        ]
        heights, _ = rendering.render(header, integers, decoder.delay_samples, positions, len(time_s), PIEZO_STACK)
        made: NDArray[np.float64] = heights[:, 0].astype(np.float64) * gain
        return made

    taken_s = np.arange(0, SECONDS, POSITION_S)
    rows: list[tuple[str, float]] = []
    figure = Figure(figsize=(11, 9), layout="constrained")
    axes = figure.subplots(len(SHOWN_MM_S) + 1, 1)
    settled = slice(round(SETTLED_S * rate_hz), None)
    for speed_mm_s in SPEEDS_MM_S:
        made = rendered(position_playback.Movement(taken_s, speed_mm_s * taken_s))
        places_m = speed_mm_s / 1000 * (time_s - late_s)
        exact = resampled(period_um, places_m, header.rate_hz, BAND_PART * rate_hz / (speed_mm_s / 1000))
        rows.append((f"snr_db_at_{speed_mm_s}_mm_s", snr_db(made[settled], exact[settled])))
        if speed_mm_s in SHOWN_MM_S:
            title = f"{speed_mm_s} mm/s: SNR {rows[-1][1]:.0f} dB up to {BAND_PART * rate_hz:.0f} Hz"
            _draw(axes[SHOWN_MM_S.index(speed_mm_s)], time_s - SETTLED_S, made, exact, title)
    turning = position_playback.Movement(taken_s, 2 - 50 * np.abs(taken_s - SETTLED_S - SHOWN_S / 2 + late_s))
    made = rendered(turning)
    places_m = np.interp(time_s - late_s, turning.times_s, turning.positions_mm) / 1000
    exact = resampled(period_um, places_m, header.rate_hz, BAND_PART * rate_hz / 0.05)
    _draw(axes[-1], time_s - SETTLED_S, made, exact, "a reversal at 50 mm/s: smoothed over two times 4 ms")
    axes[-1].set_xlabel("time, s")
    axes[0].legend(loc="upper right")
    figure.suptitle(f"{PROFILE.name}, coded once ({stream.size_bytes} bytes), under a hand")
    figure.savefig(out / "profiles.png", dpi=80)
    rows += cost(decoded[:, 0], header.rate_hz).items()
    with (out / "profiles.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(("figure", "value"))
        writer.writerows((name, f"{value:.4g}" if value < 1000 else f"{value:.0f}") for name, value in rows)


def _draw(
    axes: Axes, time_s: NDArray[np.float64], made: NDArray[np.float64], exact: NDArray[np.float64], title: str
) -> None:
    axes.plot(
        time_s,
        exact,
        color="#f0a030",
        linewidth=3,
        label=f"the decoded profile, resampled exactly up to {BAND_PART * PIEZO_STACK.dac_rate_hz:.0f} Hz",
    )
    axes.plot(time_s, made, color="#20123a", linewidth=1, label="rendered")
    axes.set_xlim(0, SHOWN_S)
    axes.set_ylabel("um")
    axes.set_title(title, loc="left", fontsize="medium")
    axes.grid(alpha=0.3)


if __name__ == "__main__":
    main()
