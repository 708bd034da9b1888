"""Training of the learned codec, at a tiny width: it learns, resumes as if uncut, and rejects what it cannot use."""

import tomllib
from collections.abc import Callable
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from msgspec.structs import replace

from tests.command import run
from vibrocast import textures
from vibrocast.errors import InputError
from vibrocast.export import checkpoint, configuration, training, training_data
from vibrocast.export.checkpoint import Checkpoint
from vibrocast.export.configuration import ArchiveSource, Augmentation, HeldBack, by_trace
from vibrocast.export.eva import Eva, EvaShape
from vibrocast.export.priors import FactorisedPrior, probabilities
from vibrocast.export.training_data import Excerpts, Trace
from vibrocast.models import ModelError
from vibrocast.textures import TextureError, dataset

TINY = """
name = "tiny"
[model]
width = 16
lambda = 30
[training]
steps = 40
batch = 4
excerpt_samples = 256
validate_every = 10
validation_excerpts = 8
warm_up_steps = 5
learning_rate = 2e-2
[generator]
kinds = ["rough", "taps", "wood"]
recordings = 2
seconds = 0.5
"""


def untold(part: float, details: str = "", /) -> None:
    """Report nothing."""


def configured(path: Path, text: str = TINY) -> configuration.Configuration:
    (path / "tiny.toml").write_text(text)
    return configuration.read(path / "tiny.toml")


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("trained")
    training.train(configured(folder), folder, folder / "uncut", False, untold, 1)
    return folder / "uncut"


def test_the_loss_falls_and_the_curves_say_so(trained: Path) -> None:
    last = checkpoint.load(trained / training.CHECKPOINT)
    losses = [record["loss"] for record in last.curves]
    assert [record["step"] for record in last.curves] == [10, 20, 30, 40]
    assert losses[-1] < 0.95 * losses[0]
    assert {"bits_per_sample", "snr_db"} < last.curves[-1].keys()


@pytest.mark.slow
def test_a_resumed_training_equals_an_uncut_one(trained: Path, tmp_path: Path) -> None:
    class Cut(Exception):
        pass

    def cutting(part: float, details: str = "", /) -> None:
        if part >= 0.6:
            raise Cut

    chosen = configured(tmp_path)
    with pytest.raises(Cut):
        training.train(chosen, tmp_path, tmp_path / "cut", False, cutting, 1)
    assert checkpoint.load(tmp_path / "cut" / training.CHECKPOINT).progress["step"] == 20
    training.train(chosen, tmp_path, tmp_path / "cut", True, untold, 1)
    uncut, resumed = (checkpoint.load(folder / training.CHECKPOINT) for folder in (trained, tmp_path / "cut"))
    for module in ("model", "prior"):
        for name, values in getattr(uncut, module).state_dict().items():
            torch.testing.assert_close(getattr(resumed, module).state_dict()[name], values, rtol=0, atol=0)
    assert [record["loss"] for record in resumed.curves] == [record["loss"] for record in uncut.curves]


def test_a_loss_that_explodes_stops_the_training_with_the_last_good_checkpoint(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    excerpts: Callable[..., Any] = Excerpts.batch
    monkeypatch.setattr(
        Excerpts, "batch", lambda self, step, size: excerpts(self, step, size) * (np.nan if step == 25 else 1)
    )
    with pytest.raises(training.TrainingError, match=r"nan at step 26.*learning_rate"):
        training.train(configured(tmp_path), tmp_path, tmp_path / "out", False, untold, 1)
    assert checkpoint.load(tmp_path / "out" / training.CHECKPOINT).progress["step"] == 20


@pytest.mark.slow
def test_the_plain_and_the_perceptual_loss_fall(tmp_path: Path) -> None:
    chosen = configured(tmp_path)
    for distortion in ("plain", "acceleration", "displacement"):
        schedule = replace(chosen.training, distortion=distortion)
        one = replace(chosen, training=schedule)
        training.train(one, tmp_path, tmp_path / distortion, False, untold, 1)
        curves = checkpoint.load(tmp_path / distortion / training.CHECKPOINT).curves
        assert curves[-1]["loss"] < curves[0]["loss"]


def test_the_probabilities_of_all_values_sum_up_to_one() -> None:
    torch.manual_seed(0)
    with torch.no_grad():
        bits = FactorisedPrior(3).bits(torch.arange(-300.0, 301.0).expand(1, 3, -1))
    assert torch.all(torch.abs(torch.exp2(-bits).sum(dim=2) - 1) < 0.01)


def test_tables_of_the_factorised_prior_are_its_bits() -> None:
    torch.manual_seed(0)
    prior = FactorisedPrior(4)
    with torch.no_grad():
        bits = prior.bits(torch.arange(-3.0, 4.0).expand(1, 4, -1))[0]
    np.testing.assert_allclose(-np.log2(probabilities(prior, 3)), bits.numpy(), atol=1e-3)


def test_excerpts_are_of_rms_one_and_of_seed_and_step_alone() -> None:
    noise = np.random.default_rng(0).standard_normal(3000).astype(np.float32)
    traces = [Trace("a", "a/one", noise), Trace("b", "b/short", noise[:100])]
    augmentation = configuration.Augmentation(gain_db=0)
    one, other = (Excerpts(traces, 256, 2800, augmentation, 5) for _ in range(2))
    np.testing.assert_array_equal(one.batch(7, 4), other.batch(7, 4))
    assert not np.array_equal(one.batch(7, 4), one.batch(8, 4))
    np.testing.assert_allclose(np.sqrt(np.mean(one.batch(7, 4) ** 2, axis=1)), 1, rtol=1e-5)


def test_a_recording_of_one_sample_is_trained_on_and_silence_is_rejected() -> None:
    def excerpts(samples: list[float]) -> Excerpts:
        trace = Trace("lab", "lab/wood", np.array(samples, dtype=np.float32))
        unvaried = Augmentation(0, 0, False, 0, 0, 0)
        return Excerpts([trace], 256, 2800, unvaried, seed=1)

    np.testing.assert_allclose(np.mean(excerpts([3.0]).batch(0, 2) ** 2, axis=1), 1.0, rtol=1e-5)
    with pytest.raises(TextureError, match="silent"):
        excerpts([3.0] + 10**6 * [0.0]).batch(0, 8)


@pytest.mark.parametrize("values", [{"rate_hz": 2800, "wood_1": np.ones(9) * 1j}, None])
def test_archives_that_cannot_be_used_are_rejected(values: dict[str, Any] | None, tmp_path: Path) -> None:
    if values:
        np.savez(tmp_path / "takes.npz", **values)
    with pytest.raises(TextureError, match="not of numbers" if values else "no such file"):
        training_data.load([ArchiveSource("takes.npz")], tmp_path, 2800)


def test_archives_folders_and_generators_are_sources_split_by_material(tmp_path: Path) -> None:
    noise = np.random.default_rng(0).standard_normal(2200)
    np.savez(tmp_path / "takes.npz", rate_hz=2200, mat1_1=noise, mat1_2=noise, mat2_1=noise, silence_1=np.zeros(2200))
    (tmp_path / "p1918").mkdir()
    for material in ("Foam", "Paper", "cork", "felt", "rubber"):
        np.savetxt(tmp_path / "p1918" / f"Direct_-_probe_-_{material}_-_slow_Z.txt", noise)
    text = TINY + (
        '[[archive]]\narchive = "takes.npz"\ndrop_s = 0.2\nhigh_pass_hz = 30\n'
        '[[folder]]\nfolder = "p1918"\npart = "train"\nunit = "m/s^2"\n'
    )
    chosen = configured(tmp_path, text)
    traces = training_data.load(chosen.sources, tmp_path, 2800)
    materials = {trace.material for trace in traces}
    assert {"takes/mat1", "takes/mat2", "generator/rough"} < materials
    assert not any("silence" in material for material in materials)
    assert sum(material.startswith("p1918/") for material in materials) == 4
    assert {len(trace.samples) for trace in traces if trace.source == "takes"} == {2240}
    train, held_back = training_data.split(traces, HeldBack(materials=("takes/mat2",)), 1)
    assert {trace.material for trace in held_back} == {"takes/mat2"}
    assert len(train) == len(traces) - 1
    shares = training_data.split(traces, HeldBack(share=0.4), 1)
    assert not {trace.material for trace in shares[0]} & {trace.material for trace in shares[1]}
    with pytest.raises(TextureError, match="no material 'takes/mat9'"):
        training_data.split(traces, HeldBack(materials=("takes/mat9",)), 1)
    with pytest.raises(TextureError, match="leave none"):
        training_data.split(traces, HeldBack(materials=tuple(materials)), 1)


def test_a_split_by_trace_holds_back_what_a_benchmark_tests(tmp_path: Path) -> None:
    noise = np.random.default_rng(0).standard_normal(2800)
    for material in ("Foam", "Paper", "cork", "felt", "rubber"):
        for axis, speed in product("XYZ", ("slow", "fast")):
            np.savetxt(tmp_path / f"Direct_-_probe_-_{material}_-_{speed}_{axis}.txt", noise)
    chosen = by_trace(configured(tmp_path))
    traces = training_data.load(chosen.sources, tmp_path, 2800)
    train, held_back = training_data.split(traces, chosen.held_back, chosen.seed)
    tested = dataset.split(dataset.entries(tmp_path), "test", by="recording")
    assert (len(train), len(held_back), len(tested)) == (8, 2, 2)
    assert {trace.material for trace in held_back} == {f"./{entry.material}" for entry in tested}
    with pytest.raises(TextureError, match="leave none to hold back"):
        training_data.split(train, chosen.held_back, chosen.seed)


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        ('name = "tiny"', "", "name is missing"),
        ("steps = 40", "step = 40", r"\[training\]: there is no key step; did you mean steps\?"),
        ("width = 16", "width = 4", r"\[model\]: width = 4 is out of range: a whole number from 16 to 128"),
        ("lambda = 30", 'lambda = "many"', r"\[model\]: lambda must be a number from 0.001 to 1e\+06, not 'many'"),
        ('"rough", "taps", "wood"', '"glass"', "kinds must be one of grating, .*, not 'glass'"),
        ("lambda = 30\n", "", r"\[model\]: lambda is missing"),
        ("[generator]", "[held_back]\nshare = nan\n[generator]", "share must be a number from 0.01 to 0.9, not nan"),
        ("excerpt_samples = 256", "excerpt_samples = 257", "multiple of 16"),
        (TINY[TINY.index("[generator]") :], "", "nothing to train on"),
        ("[generator]", "[sweep]\nlambdas = [1]\nsteps = [2, 3]\n[generator]", "2 steps for 1 lambdas"),
        ('"tiny"', f'"{41 * "a"}"\nsweep = {{ widths = [20] }}', "at most 41"),
    ],
)
def test_configurations_that_cannot_be_used_are_rejected_with_the_reason(
    old: str, new: str, reason: str, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=reason):
        configured(tmp_path, TINY.replace(old, new))


@pytest.mark.parametrize(
    ("name", "value", "reason"),
    [
        ("format", "other", "not a checkpoint of a model"),
        ("version", 1, "version must be one of 2, not 1"),
        ("shape", {"width": 10**6, "latents": 16}, "width = 1000000 is out of range"),
        ("shape", {"width": 8, "latents": 16}, "arrays of its model do not fit its shape"),
        ("prior", {}, "arrays of its prior"),
        ("model", {}, "arrays of its model"),
        ("curves", None, "curves"),
        ("curves", [{"step": 1}], "curves"),
        ("progress", {}, "step is missing"),
        ("progress", {"step": "1", "seconds": 0.0}, "step must be a whole number"),
        ("progress", {"step": 1, "seconds": float("nan")}, "seconds must be a number"),
        ("training", None, "training must be a table"),
    ],
)
def test_bad_checkpoints_are_rejected_with_the_reason(
    name: str, value: object, reason: str, trained: Path, tmp_path: Path
) -> None:
    content = torch.load(trained / training.CHECKPOINT, weights_only=True)
    torch.save({**content, name: value}, tmp_path / "bad.pt")
    with pytest.raises(ModelError, match=reason):
        checkpoint.load(tmp_path / "bad.pt")


def test_files_that_are_no_checkpoints_are_rejected(trained: Path, tmp_path: Path) -> None:
    whole = (trained / training.CHECKPOINT).read_bytes()
    for number, content in enumerate((b"", b"\x80\x02.", b"PK\x03\x04", whole[:-100], whole[: len(whole) // 2])):
        (tmp_path / f"{number}.pt").write_bytes(content)
        with pytest.raises(ModelError, match="not a checkpoint"):
            checkpoint.load(tmp_path / f"{number}.pt")
    torch.save([1], tmp_path / "list.pt")
    with pytest.raises(ModelError, match="not a checkpoint of a model"):
        checkpoint.load(tmp_path / "list.pt")
    with pytest.raises(ModelError, match="no such file"):
        checkpoint.load(tmp_path)


def test_numbers_that_are_not_finite_are_rejected(tmp_path: Path) -> None:
    model = Eva(EvaShape(8, 16))
    with torch.no_grad():
        next(model.parameters())[0, 0] = torch.nan
    Checkpoint(model, FactorisedPrior(16), {}).save(tmp_path / "nan.pt")
    with pytest.raises(ModelError, match="not finite"):
        checkpoint.load(tmp_path / "nan.pt")


def test_the_command_trains_resumes_and_rejects(tmp_path: Path) -> None:
    configured(tmp_path, TINY.replace("steps = 40", "steps = 10"))
    out = tmp_path / "out"
    done = run("train", tmp_path / "tiny.toml", "--out", out)
    assert done.exit_code == 0, done.output
    assert "bit/sample" in done.output
    again = run("train", tmp_path / "tiny.toml", "--out", out)
    assert (again.exit_code, "--resume" in again.output) == (1, True)
    configured(tmp_path, TINY.replace("width = 16", "width = 32"))
    other = run("train", tmp_path / "tiny.toml", "--out", out, "--resume")
    assert (other.exit_code, "another model" in other.output) == (2, True)
    configured(tmp_path, TINY.replace("steps = 40", "steps = 20"))
    more = run("train", tmp_path / "tiny.toml", "--out", out, "--resume")
    assert "all 20 steps done" in more.output
    assert run("train", tmp_path / "missing.toml").exit_code == 2


def test_a_checkpoint_s_configuration_is_read_again_with_what_it_leaves_out() -> None:
    text = TINY[: TINY.index("[generator]")] + '[[folder]]\nfolder = "own"\n'
    chosen = configuration.parsed(tomllib.loads(text))
    assert chosen.folder[0].rate_hz is None and chosen.generator is None
    assert configuration.parsed(chosen.as_dict()) == chosen


@pytest.mark.slow
def test_a_sweep_trains_every_width_and_lambda_by_name(tmp_path: Path) -> None:
    configured(tmp_path, TINY + "[sweep]\nwidths = [20]\nlambdas = [1, 20]\nsteps = [2, 3]\n")
    done = run("train", tmp_path / "tiny.toml", "--out", tmp_path / "out")
    assert done.exit_code == 0, done.output
    for number, lambda_ in enumerate((1.0, 20.0), 1):
        one = checkpoint.load(tmp_path / "out" / f"tiny-20-{number}" / training.CHECKPOINT)
        assert one.model.shape == EvaShape(20, 20)
        assert one.training["model"]["lambda"] == lambda_
        assert one.progress["step"] == 1 + number


def test_the_examples_can_be_read() -> None:
    folder = Path(__file__).parents[2] / "examples"
    names = [one.name for path in folder.glob("eva*.toml") for one in configuration.each_of(configuration.read(path))]
    assert {"eva-16-1", "eva-128-8", "eva-16-perceptual-1"} <= set(names)
    assert set(textures.GENERATORS)


def test_an_offset_of_recordings_is_not_trained_on(tmp_path: Path) -> None:
    noise, found = np.random.default_rng(0).standard_normal(2800), []
    for name, offset in (("flat", 0.0), ("gravity", 9.81)):
        (tmp_path / name).mkdir()
        np.savetxt(tmp_path / name / "Direct_-_probe_-_cork_-_slow_Z.txt", noise + offset)
        text = TINY + f'[[folder]]\nfolder = "{name}"\nunit = "m/s^2"\n'
        traces = training_data.load(configured(tmp_path, text).sources, tmp_path, 2000)
        found += [trace.samples for trace in traces if trace.source == name]
    np.testing.assert_allclose(found[0], found[1], atol=1e-4)
