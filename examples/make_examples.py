"""Makes the textures of this folder again, byte for byte: `python examples/make_examples.py [FOLDER]`."""

from pathlib import Path

import click
import numpy as np

from vibrocast.textures import Recording, save, save_profile
from vibrocast.textures.generate import ridges, rough, rough_profile, taps, varying_speed, wood

RATE_HZ = 2800.0
SECONDS = 4.0
FINGER_DISTANCE_S = 0.25  # two fingertips 15 mm apart, moved at 60 mm/s


def make_examples(folder: Path) -> None:
    """Write every example into `folder`."""
    hand = varying_speed(SECONDS, RATE_HZ, mean_mm_s=60, variation=0.6, period_s=1.6)
    save(folder / "oak.wav", wood(1, SECONDS, hand, RATE_HZ), sixteen_bit=True)
    save(folder / "cloth_two_fingers.wav", two_fingers(), sixteen_bit=True)
    save(
        folder / "sandpaper.wav",
        rough(3, SECONDS, 60.0, RATE_HZ, hurst=0.3, roll_off_mm=0.4, rms_um=6),
        sixteen_bit=True,
    )
    save(folder / "taps.wav", taps(4, SECONDS, 50.0, RATE_HZ), sixteen_bit=True)
    save_profile(folder / "leather_profile.csv", rough_profile(5, length_mm=8.0, spacing_um=4.0, rms_um=6.0))


def two_fingers() -> Recording:
    """Return one woven surface as two fingertips feel it, one after the other: one channel each."""
    seconds = SECONDS + FINGER_DISTANCE_S
    weave = ridges(2, seconds, 60.0, RATE_HZ, pitch_mm=0.7, jitter=0.15, width_mm=0.12, height_um=25)
    threads = rough(2, seconds, 60.0, RATE_HZ, hurst=0.8, roll_off_mm=0.5, rms_um=3)
    surface = weave.samples[:, 0] + threads.samples[:, 0]
    later = round(FINGER_DISTANCE_S * RATE_HZ)
    return Recording(np.stack([surface[later:], surface[:-later]], axis=1), RATE_HZ, "um", "cloth")


@click.command()
@click.argument("folder", type=click.Path(file_okay=False, path_type=Path), default=Path(__file__).parent)
def main(folder: Path) -> None:
    """Write the textures into FOLDER. Default: the folder of this script."""
    make_examples(folder)


if __name__ == "__main__":
    main()
