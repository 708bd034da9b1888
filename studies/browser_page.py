"""A hook of the documentation site: puts the core and coded examples into the page that plays in a browser."""

import base64
import json
from pathlib import Path
from typing import Any

import numpy as np
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

from vibrocast import codec, textures
from vibrocast.codec.encoding import encode_recording
from vibrocast.firmware.build import build

ROOT = Path(__file__).resolve().parents[1]
SCRIPT = "javascripts/player_data.js"
EXAMPLES = {
    "oak": "A stylus across oak",
    "sandpaper": "A probe over sandpaper",
    "cloth_two_fingers": "Cloth under two fingers",
    "taps": "Taps on a hard surface",
}
SNRS_DB = range(3, 31, 3)
"""Rate points of each example. The browser has no encoder: the transform before the core's is in Python."""
PACKET_SAMPLES, PACKET_BYTES = 4096, 2036
"""Packets that every board holds which ships."""


def _text(data: bytes) -> str:
    return base64.b64encode(data).decode()


def example(name: str) -> dict[str, Any]:
    """Return an example for the page.

    `original`: what was coded, float32 (n, channels) in its unit. `streams`: .vct files from the lowest SNR on.
    """
    recording = textures.load(ROOT / "examples" / f"{name}.wav")
    coded = [encode_recording(recording, snr_db=snr_db) for snr_db in SNRS_DB]
    streams = [each.stream.repacked(PACKET_SAMPLES, PACKET_BYTES) for each in coded]
    original = coded[0].recording.samples.astype("<f4")
    return {
        "name": name,
        "title": EXAMPLES[name],
        "original": _text(np.ascontiguousarray(original).tobytes()),
        "streams": [_text(bytes(stream)) for stream in streams],
    }


def script() -> str:
    """Return a script with the core as WebAssembly, the codecs' names and the examples. Raises BuildError."""
    data = {
        "core": _text(build("wasm").read_bytes()),
        "codecs": {each.identifier: each.name for each in codec.BUILT_IN.values()},
        "examples": [example(name) for name in EXAMPLES],
    }
    return f"/* Written by studies/browser_page.py. */\nconst PLAYER_DATA = {json.dumps(data)};\n"


def on_files(files: Files, *, config: MkDocsConfig) -> Files:
    """Add the script to the site. It is one file with everything, because a page from the disk may fetch no other."""
    files.append(File.generated(config, SCRIPT, content=script()))
    return files
