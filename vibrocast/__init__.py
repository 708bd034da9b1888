"""Compress vibrotactile textures and play them in real time on an actuator."""

# ruff: noqa: F403, F405 - type checkers find the names of __all__ in the API

import logging
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from vibrocast.api import *

logging.getLogger(__name__).addHandler(logging.NullHandler())  # a program that uses this package decides

__all__ = [
    "Actuator",
    "Codec",
    "Connection",
    "Profile",
    "Recording",
    "Report",
    "Stream",
    "VibrocastError",
    "codecs",
    "connect",
    "decode",
    "encode",
    "load",
    "load_profile",
    "measure",
    "register",
    "render",
]


def __getattr__(name: str) -> Any:
    """Import the API at its first use: `import vibrocast` and the command's help stay fast."""
    if name not in __all__:
        raise AttributeError(f"module 'vibrocast' has no attribute {name!r}")
    from vibrocast import api

    return getattr(api, name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
