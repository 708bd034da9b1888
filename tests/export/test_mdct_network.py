"""The network of `mdct`: trained, packed into an image, and the same in integers as in training."""

from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

pytest.importorskip("torch")

import torch

from tests.codec.reference_decoder import Network as ReferenceNetwork
from vibrocast import codec
from vibrocast.codec import Framing, mdct
from vibrocast.device_protocol.model_image import ModelImage
from vibrocast.export import mdct_network, mdct_tables
from vibrocast.textures.generate import rough


def textures() -> list[codec.Signal]:
    return [rough(seed, 3.0).samples / np.max(np.abs(rough(seed, 3.0).samples)) for seed in range(6)]


@pytest.mark.slow
def test_a_trained_network_saves_bits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mdct_network, "STEPS", 300)
    archive, image = tmp_path / "rough.npz", tmp_path / "rough.vcmi"
    takes = {f"take{number}": texture[:, 0] for number, texture in enumerate(textures())}
    np.savez(archive, rate_hz=2800, **takes)  # type: ignore[arg-type]
    arguments = [str(archive), "--network", "--drop-s", "0", "--image", str(image)]
    done = CliRunner().invoke(mdct_tables.main, arguments)
    assert done.exit_code == 0, done.output
    payload = ModelImage.unpack(image.read_bytes()).payload
    codec.check_tables(mdct.IDENTIFIER, payload)
    unheard = rough(99, 2.0).samples
    sizes = [
        sum(map(len, codec.encode(unheard, 2800, {"step": 0.5, "hop": "32"}, model=codec.Model(tables)).packets))
        for tables in (payload, mdct.untrained_tables())
    ]
    assert sizes[0] < 0.9 * sizes[1]


def test_integers_predict_what_training_saw() -> None:
    """The reference's integers, which the core's are held to, against the floating point of training."""
    torch.manual_seed(1)
    encoder = mdct.MdctEncoder((0.1,), 2800, Framing(512, 0))
    encoder.record(400)
    encoder.encode(textures()[0])
    rows = encoder.examples()
    assert len(rows) == 400
    network = mdct_network.Network(rows.shape[1] - 2)
    with torch.no_grad():
        expected = 256 * network(torch.from_numpy(rows[:, :-2]).float() / 16).numpy()
    reference = ReferenceNetwork(network.payload())
    for row, both in zip(rows[::10], expected[::10], strict=True):
        for quantiser, logits in enumerate(both):
            assert reference.logits(list(row[:-2]), quantiser) == pytest.approx(np.clip(logits, -2047, 2047), abs=3)


def test_examples_are_what_was_coded() -> None:
    """A row for each coefficient of blocks that are not silent: last the index, first the magnitude below."""
    encoder = mdct.MdctEncoder((0.05,), 2800, Framing(512, 0))
    encoder.record(100_000)
    packets = encoder.encode(textures()[1])
    rows = encoder.examples()
    assert len(rows) % 32 == 0
    assert 0 < len(rows) <= 512 * len(packets)
    assert set(rows[:, -2]) == {0, 1}
    index, quantiser, below = rows[:-1, -1], rows[:-1, -2], rows[1:, 0]
    same_block = np.arange(1, len(rows)) % 32 != 0
    zero = (index == 0) & same_block
    assert np.all(below[zero] == 0)
    assert np.all(below[same_block & (index > 0)] > 0)
    assert not np.any(rows[::32, :3])
    assert np.all(quantiser >= 0)


def test_bits_are_those_of_the_unary_decisions() -> None:
    logits = torch.zeros(3, 2, 6)
    cost = mdct_network.bits(logits, torch.tensor([0, 1, 0]), torch.tensor([0, 4, 15]))
    assert cost.tolist() == pytest.approx([1.0, 5.0, 15.0])
