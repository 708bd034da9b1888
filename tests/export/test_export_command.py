"""Tests of `vibrocast export`: a checkpoint becomes a folder that codes and plays; other files are rejected."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn

import onnx
import pytest
import torch

from tests.command import fails, run, succeeds
from tests.export import tiny
from vibrocast import codec, models, textures
from vibrocast.codec.encoding import encode_recording
from vibrocast.codec.eva_image import EvaImage
from vibrocast.export import model_card
from vibrocast.export.graphs import described


@pytest.fixture(scope="session")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("trained") / "checkpoint.pt"
    tiny.checkpoint().save(path)
    return path


@pytest.fixture(scope="session")
def exported(trained: Path) -> Path:
    out = trained.with_name("exported")
    succeeds("export", trained, "--out", out, "--runtime", "both")
    return out


def test_the_folder_holds_a_model(exported: Path) -> None:
    model = models.load(exported)
    assert sorted(path.name for path in exported.iterdir()) == sorted(
        ["analysis.onnx", "synthesis.onnx", "tiny.vcmi", "card.json", "card.md", "curves.csv", "curves.png"]
    )
    assert (model.name, model.family) == ("tiny", "tiny")
    codec.check_tables(model.codec_identifier, model.tables)
    image = EvaImage.unpack(model.tables)
    assert (image.width, image.latents, image.prior, image.runtime) == (16, 16, "adaptive", "core")
    assert described(image.graph, 2800) == (exported / "synthesis.onnx").read_bytes()
    for file in ("analysis.onnx", "synthesis.onnx"):
        graph = onnx.load(exported / file)
        onnx.checker.check_model(graph, full_check=True)
        stated = {each.key: each.value for each in graph.metadata_props}
        assert stated == {"rate_hz": "2800", "samples_per_column": "16", "scaling": "rms", "latent_step": "1"}


def test_the_card_says_what_the_model_is_and_does(exported: Path) -> None:
    card = models.load(exported).card
    assert card["shape"] == {"width": 16, "latents": 16}
    assert card["prior"] == "adaptive"
    (data,) = card["training"]["data"]
    assert (data["name"], data["recordings"]) == ("generator", 2)
    assert data["hours"] == pytest.approx(2 / 3600, rel=0.01)
    assert card["training"]["held_back"] == ["generator/grating", "generator/wood"]
    assert (card["training"]["seed"], card["training"]["steps"]) == (1, 1)
    assert max(card["export"]["parity"].values()) <= 1e-5
    point = card["results"]["point"]
    assert 0 < point["bits_per_sample"] < point["bits_per_sample_static"]
    assert point["snr_db"] == pytest.approx(point["snr_db_by_onnx"], abs=0.3)
    for file, about in card["files"].items():
        assert about["bytes"] == (exported / file).stat().st_size


def test_the_same_checkpoint_gives_the_same_files(trained: Path, exported: Path, tmp_path: Path) -> None:
    succeeds("export", trained, "--out", tmp_path / "again", "--runtime", "both")
    for file in ("analysis.onnx", "synthesis.onnx", "tiny.vcmi"):
        assert (tmp_path / "again" / file).read_bytes() == (exported / file).read_bytes()


def test_an_image_holds_the_requested_parts(trained: Path, tmp_path: Path) -> None:
    succeeds(
        *("export", trained, "--name", "other", "--version", "2", "--out", tmp_path / "new" / "out"),
        *("--runtime", "onnx"),
    )
    model = models.load(tmp_path / "new" / "out")
    image = EvaImage.unpack(model.tables)
    assert image.prior == "adaptive" == model.card["prior"]
    assert (model.name, model.card["version"], image.runtime, image.network) == ("other", "2", "onnx", None)
    encoding = encode_recording(textures.GENERATORS["rough"](seed=5, seconds=0.5), setting={"level": 1.0}, model=model)
    assert encoding.quality.snr_db is not None and encoding.quality.snr_db > 8


@pytest.mark.parametrize(
    ("change", "advice"),
    [
        (lambda content: {"weight": torch.zeros(3)}, "give one that"),
        (
            lambda content: {**content, "model": {key: 0 * each for key, each in content["model"].items()}},
            "train it again",
        ),
        (
            lambda content: {**content, "model": {key: each.to_sparse() for key, each in content["model"].items()}},
            "train the model again",
        ),
        (lambda content: {**content, "training": {"name": "tiny"}}, "missing"),
    ],
)
def test_bad_checkpoints_are_rejected(
    change: Callable[[dict[str, Any]], dict[str, Any]], advice: str, trained: Path, tmp_path: Path
) -> None:
    torch.save(change(torch.load(trained, weights_only=True)), tmp_path / "other.pt")
    assert advice in fails(2, "export", tmp_path / "other.pt", "--out", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_what_is_no_model_is_not_replaced(trained: Path, exported: Path, tmp_path: Path) -> None:
    (tmp_path / "letters").mkdir()
    (tmp_path / "letters" / "to_a_friend").write_text("dear")
    assert "give another --out" in fails(2, "export", trained, "--out", tmp_path / "letters")
    assert "small letters" in fails(2, "export", trained, "--name", "../up", "--out", tmp_path / "up")
    assert [path.name for path in tmp_path.rglob("*")] == ["letters", "to_a_friend"]
    out = shutil.copytree(exported, tmp_path / "model")
    (out / "recording.wav").touch()
    assert "holds other files than a model" in fails(2, "export", trained, "--out", out)
    assert (out / "recording.wav").exists()


def test_data_that_are_not_there_are_named(tmp_path: Path) -> None:
    checkpoint = tiny.checkpoint()
    checkpoint.training["archive"] = [{"archive": "recordings.npz", "drop_s": 0.0, "high_pass_hz": 0.0}]
    checkpoint.save(tmp_path / "checkpoint.pt")
    rejection = fails(2, "export", tmp_path / "checkpoint.pt", "--out", tmp_path / "out", "--data", tmp_path)
    assert "recordings.npz" in rejection
    assert not (tmp_path / "out").exists()


def test_a_failed_export_leaves_the_model_that_was_there(
    trained: Path, exported: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(card: Any) -> NoReturn:
        raise OSError(28, "No space left on device", "card.md")

    before = {path.name: path.read_bytes() for path in exported.iterdir()}
    monkeypatch.setattr(model_card, "as_markdown", full)
    failed = run("export", trained, "--name", "other", "--out", exported)
    assert failed.exit_code == 2
    assert "free some space" in failed.stderr
    assert {path.name: path.read_bytes() for path in exported.iterdir()} == before
    assert not [path.name for path in exported.parent.iterdir() if path.name.startswith(".")]


def test_a_training_that_was_cut_is_not_exported(tmp_path: Path) -> None:
    cut = tiny.checkpoint()
    cut.training["training"]["steps"] = 2
    cut.save(tmp_path / "checkpoint.pt")
    assert "was cut at step 1 of 2; continue it with `vibrocast train --resume`" in fails(
        2, "export", tmp_path / "checkpoint.pt", "--out", tmp_path / "model"
    )


def test_an_image_is_signed_as_it_is_exported(trained: Path, tmp_path: Path) -> None:
    key, out = tmp_path / "vendor.pem", tmp_path / "signed"
    succeeds("keys", "new", key)
    succeeds("export", trained, "--out", out, "--sign", key, 3)
    told = succeeds("keys", "verify", out, "--public-key", tmp_path / "vendor.pub.pem")
    assert "number 3" in told
    assert "cannot be used" in fails(2, "export", trained, "--out", out, "--sign", key, 0)
