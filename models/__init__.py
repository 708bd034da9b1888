"""Trained models, those that ship and those in your folders: by name, by the hash of an image, from a path."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from pathlib import Path
from typing import Any

from vibrocast.device_protocol.model_image import MAX_IMAGE_BYTES, ModelImage, sha256
from vibrocast.device_protocol.model_image import ModelError as ModelError
from vibrocast.errors import located
from vibrocast.files import read_input

CARD = "card.json"
ANALYSIS = "analysis.onnx"
IMAGE_SUFFIX = ".vcmi"
_FOLDER = Path(__file__).parent


@dataclass(frozen=True)
class Model:
    """A trained model.

    `name`: of the image. `path`: of the image's file. `image`: the packed model image, which a controller stores.
    `analysis`: ONNX graph of the analysis transform, empty if the codec has no learned one or only an image was given.
    `card`: content of card.json, see models/README.md; empty for a lone image.
    """

    name: str
    path: Path
    image: bytes
    analysis: bytes = b""
    card: Mapping[str, Any] = field(default_factory=dict)

    @property
    def family(self) -> str:
        """Name of its family: models with one rate each that make one curve. Alone, it is its own family."""
        return str(self.card.get("family", self.name))

    @property
    def is_perceptual(self) -> bool:
        """Whether the training weighed errors by the threshold of touch, so that equal SNR takes more bits."""
        configuration = self.card.get("training", {}).get("configuration", {})
        return bool(configuration.get("training", {}).get("distortion", "plain") != "plain")

    @cached_property
    def tables(self) -> bytes:
        """The payload of the image; a decoder needs nothing else."""
        return ModelImage.unpack(self.image).payload

    @property
    def codec_identifier(self) -> int:
        """The codec's number in stream headers."""
        return ModelImage.unpack(self.image).codec_identifier


def names() -> list[str]:
    """Return the names of the models that ship."""
    return sorted(card.parent.name for card in _FOLDER.glob(f"*/{CARD}"))


@cache
def shipped() -> tuple[Model, ...]:
    """Return the models that ship, the smallest image first. Raises as `load` if their files are damaged."""
    return tuple(sorted((load(_FOLDER / name) for name in names()), key=lambda model: len(model.image)))


def members(family: str) -> list[Model]:
    """Return the models of a family that ship, from the coarsest, which has the lowest number, to the finest.

    A model with its own curve is a family of one. Raises as `load`.
    """
    found = [model for model in shipped() if model.family == family]
    return sorted(found, key=lambda model: (len(model.name), model.name))


def by_hash(beginning: bytes) -> Model | None:
    """Return the shipped model whose image's SHA-256 begins with these bytes, or None. Raises as `shipped`."""
    return next((model for model in shipped() if sha256(model.image).startswith(beginning)), None)


def find(text: str) -> Model:
    """Return the shipped model of this name, or else the model at this path. Raises as `load`."""
    if text in names():
        return load(_FOLDER / text)
    if not Path(text).exists():
        raise ModelError(
            f"no model {text}; `vibrocast models` lists them, or give a folder of `vibrocast export` or an image"
        )
    return load(Path(text))


def load(path: Path) -> Model:
    """Return the model in a folder that `vibrocast export` wrote, or that of a lone image file.

    Raises InputError for any other or a damaged file or image, OSError for a file that cannot be read.
    """
    if not path.is_dir():
        return _of_image(path, _read_file(path))
    if not (path / CARD).exists():
        raise ModelError(
            f"{path}: no folder of a model, because it has no {CARD}; give one that `vibrocast export` wrote"
        )
    text = _read_file(path / CARD)
    try:
        card = json.loads(text)
        image_file = f"{card['name']}{IMAGE_SUFFIX}"
        hashes = {file: about["sha256"] for file, about in card["files"].items()}
        image_hash = hashes[image_file]
    except (ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        raise ModelError(f"{path / CARD}: not the card of a model; export the model again") from error
    model = _of_image(path / image_file, _checked(path / image_file, image_hash))
    analysis = _checked(path / ANALYSIS, hashes[ANALYSIS]) if ANALYSIS in hashes else b""
    return replace(model, analysis=analysis, card=card)


def _of_image(path: Path, image: bytes) -> Model:
    with located(path):
        return Model(ModelImage.unpack(image).name, path, image)


def _checked(path: Path, expected: str) -> bytes:
    """Return the bytes of a file with this SHA-256."""
    data = _read_file(path)
    if hashlib.sha256(data).hexdigest() != expected:
        raise ModelError(f"{path}: not the file that {CARD} next to it describes; export the whole model again")
    return data


def _read_file(path: Path) -> bytes:
    return read_input(path, "file of a model", b"", MAX_IMAGE_BYTES)
