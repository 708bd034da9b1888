"""Plain arrays as recordings."""

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from vibrocast.textures.files import contents_of, scale_of
from vibrocast.textures.recording import Recording, TextureError


def from_array(
    samples: ArrayLike, rate_hz: float, unit: str, full_scale: float | None = None, name: str = "samples"
) -> Recording:
    """Return samples (n,) or (n, channels) of integers or floats of any size as a recording.

    `rate_hz`, `unit` (one of INPUT_UNITS), `full_scale`: as `load` takes them of an NPY file. Raises TextureError.
    """
    try:
        array = np.asarray(samples)
    except ValueError as error:
        raise TextureError(f"{name}: no array of numbers ({error}); pass shape (n,) or (n, channels)") from error
    contents = contents_of(array, None, None, Path(name))
    output_unit, scale = scale_of(contents, unit, full_scale, Path(name))
    return Recording(contents.samples * scale, rate_hz, output_unit, name)
