"""The learned transforms of `lapped`: orthogonal whatever is learned, trained, resumed, and packed as a model image."""

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("torch")

import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from vibrocast import codec
from vibrocast.codec import lapped, mdct
from vibrocast.device_protocol.model_image import ModelImage
from vibrocast.errors import InputError
from vibrocast.export import checkpoint, configuration, lapped_image, training
from vibrocast.export.lapped import TERMS, Lapped, Window, analysed, synthesised
from vibrocast.textures.generate import rough

TINY: dict[str, Any] = {
    "name": "tiny",
    "model": {"kind": "lapped"},
    "training": {
        "steps": 30,
        "batch": 4,
        "excerpt_samples": 1280,
        "validate_every": 10,
        "validation_excerpts": 6,
        "warm_up_steps": 3,
        "learning_rate": 2e-2,
        "rounding": "straight-through",
        "dead_zone": 0.15,
    },
    "archive": [{"archive": "rough.npz"}],
    "held_back": {"materials": ["rough/second"]},
}


def trained(folder: Path, tell: training.Tell = lambda part, details="": None) -> checkpoint.Checkpoint:
    """Train in a folder, or go on there, on rough textures, which are all that is held back too."""
    takes = {f"{name}_{seed}": rough(seed, 2.0).samples[:, 0] for seed, name in enumerate(("first", "second") * 3)}
    np.savez(folder / "rough.npz", rate_hz=2800, **takes)  # type: ignore[arg-type]
    out = folder / "out"
    training.train(configuration.parsed(TINY), folder, out, out.exists(), tell, 1)
    return checkpoint.load(out / training.CHECKPOINT)


@given(st.sampled_from(mdct.HOPS), st.lists(st.floats(-3, 3), min_size=2 * TERMS, max_size=2 * TERMS))
@settings(max_examples=20, deadline=None)
def test_any_window_reconstructs(hop: int, terms: list[float]) -> None:
    window = Window(hop)
    generator = torch.Generator().manual_seed(1)
    signal = torch.randn((2, 1, 10 * hop), generator=generator)
    with torch.no_grad():
        window.terms.copy_(torch.tensor(terms).reshape(2, TERMS))
        matrix = window.matrix()
        again = synthesised(analysed(signal, matrix), matrix)
    inner = slice(3 * hop, -3 * hop)
    torch.testing.assert_close(again[..., inner], signal[..., inner], rtol=0, atol=1e-4)


@pytest.mark.parametrize("hop", mdct.HOPS)
def test_training_begins_with_the_window_in_closed_form(hop: int) -> None:
    n = np.arange(2 * hop)
    expected = 0.5 * (0.5**0.5 + np.cos(np.pi * (n + 0.5 - 2 * hop) / (2 * hop)))
    np.testing.assert_allclose(Window(hop).first_half().detach().numpy(), expected, atol=1e-5)


def test_the_codec_has_the_transform_that_was_trained() -> None:
    model = Lapped()
    with torch.no_grad():
        for window in model.windows:
            assert isinstance(window, Window)
            window.terms[0, 1] = 0.05
    windows = lapped.pack_windows(model.halves())
    assert len(windows) == lapped.WINDOWS_BYTES
    for window in model.windows:
        assert isinstance(window, Window)
        matrix = window.matrix()[:, 0].detach().numpy().T
        np.testing.assert_allclose(lapped.analysis_matrix(windows, window.hop), matrix, atol=2e-5)


def test_the_loss_falls_and_a_resumed_training_equals_an_uncut_one(tmp_path: Path) -> None:
    (tmp_path / "whole").mkdir()
    whole = trained(tmp_path / "whole")
    losses = [record["loss"] for record in whole.curves]
    assert [record["step"] for record in whole.curves] == [10, 20, 30]
    assert losses[-1] < losses[0] - 0.01
    assert isinstance(whole.model, Lapped)

    class Cut(Exception):
        pass

    def cutting(part: float, details: str = "", /) -> None:
        if part > 0.7:
            raise Cut

    with pytest.raises(Cut):
        trained(tmp_path, cutting)
    resumed = trained(tmp_path)
    for module in ("model", "prior"):
        for name, values in getattr(whole, module).state_dict().items():
            torch.testing.assert_close(getattr(resumed, module).state_dict()[name], values, rtol=0, atol=0)


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"model": {"kind": "lapped", "lambda": 3}}, "neither lambda nor width"),
        ({"model": {"kind": "lapped", "width": 64}}, "neither lambda nor width"),
        ({"model": {"kind": "eva"}}, "needs lambda"),
        ({"model": {"kind": "wavelet"}}, "kind"),
        ({"sweep": {"lambdas": [1, 2]}}, "neither lambda nor width"),
        ({"training": {"excerpt_samples": 1296}}, "multiple of 128"),
        ({"training": {"excerpt_samples": 1152}}, "multiple of 128"),
    ],
)
def test_what_a_lapped_model_does_not_have_is_rejected(changes: dict[str, Any], problem: str) -> None:
    with pytest.raises(InputError, match=problem):
        configuration.parsed(TINY | changes)


@pytest.mark.slow
def test_an_image_codes_its_textures_in_fewer_bits() -> None:
    textures = [rough(seed, 3.0).samples[:, 0] / np.max(np.abs(rough(seed, 3.0).samples)) for seed in range(6)]
    packed = ModelImage.unpack(lapped_image.image(Lapped(), "rough", "1", textures, 1))
    assert (packed.codec_identifier, packed.name) == (lapped.IDENTIFIER, "rough")
    codec.check_tables(lapped.IDENTIFIER, packed.payload)
    untrained = packed.payload[: lapped.WINDOWS_BYTES] + mdct.untrained_tables()
    signal = rough(99, 2.0).samples
    code = partial(codec.encode, signal, 2800, {"step": 0.5, "hop": "32"}, codec="lapped")
    learned_bytes, untrained_bytes = (
        sum(map(len, code(model=codec.Model(payload)).packets)) for payload in (packed.payload, untrained)
    )
    assert learned_bytes < 0.9 * untrained_bytes
