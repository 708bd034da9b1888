"""The model image of a trained `lapped`: its windows, and tables trained on their coefficients."""

from collections.abc import Sequence

from vibrocast.codec import lapped
from vibrocast.codec.interface import Signal
from vibrocast.device_protocol.model_image import ModelImage
from vibrocast.export.lapped import Lapped
from vibrocast.export.mdct_training import trained


def image(model: Lapped, name: str, version: str, signals: Sequence[Signal], seed: int) -> bytes:
    """Return the packed image of a model. `signals`: float64 (n,), all those of its training.

    Raises ModelError for a name or version that an image cannot have.
    """
    windows = lapped.pack_windows(model.halves())
    textures = [signal[:, None] for signal in signals]
    tables = trained(textures, seed, lapped.transform(windows))
    return ModelImage(lapped.IDENTIFIER, name, version, "", windows + tables).pack()
