"""Height profiles of surfaces, and the recording that a probe sweeping over one would give."""

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import Polynomial

from vibrocast.textures.recording import Recording, Signal, TextureError

FORM_DEGREE = 2
MIN_HEIGHTS = 8


@dataclass(frozen=True, eq=False)
class Profile:
    """Surface height over position.

    `heights_um`: float64 (n,), n >= MIN_HEIGHTS, finite; `spacing_um`: distance between neighbours. Raises
    TextureError on anything else.
    """

    heights_um: Signal
    spacing_um: float
    name: str

    def __post_init__(self) -> None:
        if self.heights_um.ndim != 1 or len(self.heights_um) < MIN_HEIGHTS:
            raise TextureError(f"{self.name}: a height profile needs at least {MIN_HEIGHTS} heights")
        if not np.isfinite(self.heights_um).all():
            raise TextureError(f"{self.name}: some heights are not numbers; remove or repair them")
        if not np.isfinite(self.spacing_um) or self.spacing_um <= 0:
            raise TextureError(f"{self.name}: spacing {self.spacing_um} um; it must be positive")

    @property
    def length_mm(self) -> float:
        """Distance from the first height to the last."""
        return (len(self.heights_um) - 1) * self.spacing_um / 1000

    def without_form(self) -> Signal:
        """Return the heights, in um, less the least-squares parabola: less mean, tilt and curvature of the part.

        This is the F-operation of ISO 25178-2 with a polynomial of degree FORM_DEGREE.
        """
        position = np.linspace(-1.0, 1.0, len(self.heights_um))
        form = Polynomial.fit(position, self.heights_um, FORM_DEGREE)
        return self.heights_um - form(position)

    def recording(self, hand_speed_mm_s: float) -> Recording:
        """Return the height under a probe that sweeps once along the profile at one speed, form removed, in um.

        The rate is speed / spacing, so no height is left out or made up; `resample` limits the band. Raises
        TextureError on a speed that is not positive.
        """
        if not np.isfinite(hand_speed_mm_s) or hand_speed_mm_s <= 0:
            raise TextureError(f"hand speed {hand_speed_mm_s} mm/s; it must be positive (hand_speed_mm_s)")
        rate_hz = 1000 * hand_speed_mm_s / self.spacing_um
        return Recording(self.without_form().reshape(-1, 1), rate_hz, "um", self.name)
