"""Training of the codec's initial tables: reproducible, packed as an image that codes its textures in fewer bits."""

import zipfile
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result

from tests.codec.eva_models import model_with
from vibrocast import codec, models
from vibrocast.codec import mdct
from vibrocast.device_protocol.model_image import ModelImage
from vibrocast.export import mdct_tables
from vibrocast.textures.generate import rough


def archive(path: Path, **extra: object) -> Path:
    takes = {f"take{seed}": rough(seed, 4.0).samples[:, 0] for seed in range(6)}
    np.savez(path, **takes, **extra)  # type: ignore[arg-type]
    return path


def run(*arguments: object) -> Result:
    return CliRunner().invoke(mdct_tables.main, [str(argument) for argument in arguments])


def test_trained_tables_spend_fewer_bits_than_untrained_ones(tmp_path: Path) -> None:
    recordings = archive(tmp_path / "rough.npz", rate_hz=2800)
    images = [tmp_path / "one.vcmi", tmp_path / "two.vcmi"]
    for image in images:
        done = run(recordings, "--image", image, "--name", "rough")
        assert done.exit_code == 0, done.output
    assert images[0].read_bytes() == images[1].read_bytes()
    model = ModelImage.unpack(images[0].read_bytes())
    assert (model.codec_identifier, model.name) == (mdct.IDENTIFIER, "rough")
    unheard = rough(99, 2.0).samples
    trained, untrained = (
        codec.encode(unheard, 2800, {"step": 0.5}, model=model_with(tables, codec_identifier=mdct.IDENTIFIER))
        for tables in (model.payload, mdct_tables.untrained_tables())
    )
    assert sum(map(len, trained.packets)) < 0.95 * sum(map(len, untrained.packets))


def test_shipped_image_holds_the_built_in_tables() -> None:
    assert models.find("mdct-textures").tables == mdct.built_in_tables()


def test_archives_that_cannot_be_used_are_named(tmp_path: Path) -> None:
    assert "rate_hz" in run(archive(tmp_path / "a.npz"), "--image", tmp_path / "a.vcmi").output
    (tmp_path / "b.npz").write_bytes(b"no archive")
    np.savez(tmp_path / "c.npz", rate_hz=2800, short=np.zeros(10))
    np.save(tmp_path / "d.npy", np.zeros(10))
    np.savez(tmp_path / "e.npz", rate_hz=2800, words=np.array(["rough"] * 9000))
    np.savez(tmp_path / "f.npz", rate_hz=np.nan, noise=np.ones(9000))
    with zipfile.ZipFile(archive(tmp_path / "h.npz", rate_hz=2800), "a") as members:
        members.writestr("noise.npy", b"no array")
    with zipfile.ZipFile(archive(tmp_path / "i.npz", rate_hz=2800), "a") as members:
        header = {"descr": "<f8", "fortran_order": False, "shape": (2**64,)}
        with members.open("vast.npy", "w") as member:
            np.lib.format.write_array_header_1_0(member, header)
    whole = archive(tmp_path / "g.npz", rate_hz=2800).read_bytes()
    (tmp_path / "g.npz").write_bytes(whole.replace(whole[2000:2100], bytes(100)))
    for name in ("b.npz", "c.npz", "d.npy", "e.npz", "f.npz", "g.npz", "h.npz", "i.npz"):
        done = run(tmp_path / name, "--image", tmp_path / "b.vcmi")
        assert done.exit_code == 1
        assert done.output.startswith("Error: ")
    assert not list(tmp_path.glob("*.vcmi"))


@pytest.mark.parametrize("tables", [bytes(12784), mdct.built_in_tables()])
def test_source_for_the_core_holds_every_byte(tables: bytes) -> None:
    numbers = mdct_tables.c_source(tables).split("{")[1].split("}")[0]
    assert bytes(int(number) for number in numbers.split(",")) == tables
