"""Runs the transforms of a model in ONNX Runtime without vibrocast: `python onnx_runtime.py MODEL_FOLDER FILE.wav`."""

import sys
from pathlib import Path

import numpy as np
import onnxruntime
import soundfile

folder, file = map(Path, sys.argv[1:])
analysis, synthesis = (onnxruntime.InferenceSession(folder / f"{name}.onnx") for name in ("analysis", "synthesis"))
stated = analysis.get_modelmeta().custom_metadata_map
signal, rate_hz = soundfile.read(file, dtype="float32")
assert rate_hz == float(stated["rate_hz"]), "resample the file first"
column = int(stated["samples_per_column"])
padded = np.pad(signal, (2 * column, 2 * column + -len(signal) % column))[None, None]  # two columns reach the signal
scale, step = np.sqrt(np.mean(signal**2)), float(stated["latent_step"])
(latents,) = analysis.run(None, {"signal": padded / scale})
(decoded,) = synthesis.run(None, {"latents": np.round(latents / step) * step})
error = signal - decoded[0, 0, 2 * column :][: len(signal)] * scale
print(f"SNR {10 * np.log10(np.mean(signal**2) / np.mean(error**2)):.2f} dB")
