"""Height profiles of surfaces, and the recording of a probe that sweeps over one."""

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import Polynomial

from vibrocast.textures.recording import Recording, Signal, TextureError

FORM_DEGREE = 2
MIN_HEIGHTS = 8


@dataclass(frozen=True, eq=False)
class Profile:
    """Surface height over position.

    Attributes:
        heights_um: float64 (n,) in um, finite, n >= 8.
        spacing_um: Distance between neighbours in um.
        name: A name for people.

    Raises:
        TextureError: An attribute is none of these.
    """

    heights_um: Signal
    spacing_um: float
    name: str

    def __post_init__(self) -> None:
        if self.heights_um.ndim != 1 or len(self.heights_um) < MIN_HEIGHTS:
            raise TextureError(f"{self.name}: too short for a height profile; give at least {MIN_HEIGHTS} heights")
        if not np.isfinite(self.heights_um).all():
            raise TextureError(f"{self.name}: some heights are not numbers; remove or repair them")
        if not np.isfinite(self.spacing_um) or self.spacing_um <= 0:
            raise TextureError(f"{self.name}: spacing {self.spacing_um} um; it must be positive")

    @property
    def length_mm(self) -> float:
        """The distance from the first height to the last, in mm."""
        return (len(self.heights_um) - 1) * self.spacing_um / 1000

    def without_form(self) -> Signal:
        """Return the heights (n,) in um without mean, tilt and curvature.

        These are the residuals of a least-squares parabola: the F-operation of ISO 25178-2, of degree 2.
        """
        position = np.linspace(-1.0, 1.0, len(self.heights_um))
        form = Polynomial.fit(position, self.heights_um, FORM_DEGREE)
        return self.heights_um - form(position)

    def recording(self, hand_speed_mm_s: float) -> Recording:
        """Return the displacement of a probe that sweeps once along the profile at constant speed.

        The rate is speed / spacing, so every height is one sample. The form is removed.

        Args:
            hand_speed_mm_s: Speed of the hand in mm/s.

        Returns:
            A Recording in um, one channel.

        Raises:
            TextureError: The speed is not positive.
        """
        if not np.isfinite(hand_speed_mm_s) or hand_speed_mm_s <= 0:
            raise TextureError(
                f"`hand_speed_mm_s` is {hand_speed_mm_s}; it must be positive", parameter="hand_speed_mm_s"
            )
        rate_hz = 1000 * hand_speed_mm_s / self.spacing_um
        return Recording(self.without_form().reshape(-1, 1), rate_hz, "um", self.name)
