"""Bytes of the decoders: those that ship are those that the core compiles to."""

import json
from importlib.util import find_spec
from pathlib import Path

import click
import pytest
from click.testing import CliRunner

from studies import decoder_sizes
from vibrocast import codec
from vibrocast.evaluation import cost
from vibrocast.evaluation.peers import measured_codecs

needs_ziglang = pytest.mark.skipif(find_spec("ziglang") is None, reason="no compiler")


def test_every_codec_has_its_line_in_the_shipped_sizes() -> None:
    shipped = json.loads(cost.DECODER_SIZES.read_text(encoding="utf-8"))
    assert list(shipped) == list(measured_codecs()), "run python -m studies.decoder_sizes"
    assert all(size["note"] for size in shipped.values())


@needs_ziglang
def test_the_shipped_size_is_what_the_core_compiles_to() -> None:
    """To a twentieth, as compilers differ."""
    for name in codec.CODECS:
        if decoder_sizes._decoder_functions(name):
            assert cost.decoder_bytes(name) == pytest.approx(decoder_sizes.count_decoder_size(name).bytes, rel=0.05)


@needs_ziglang
def test_an_image_holds_what_the_functions_need_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "toy.h").write_text("int vc_toy_decode(int x); int vc_toy_conceal(void); int vc_toy_encode(int x);")
    (tmp_path / "one.c").write_text(
        '#include "toy.h"\n'
        "extern const unsigned char used[1000];\n"
        "int vc_toy_decode(int x) { return used[x]; }\n"
        "int vc_toy_conceal(void) { return 0; }\n"
    )
    (tmp_path / "two.c").write_text(
        '#include "toy.h"\n'
        "const unsigned char used[1000] = {1};\n"
        "const unsigned char unused[100000] = {1};\n"
        "int vc_toy_encode(int x) { return unused[x]; }\n"
    )
    monkeypatch.setattr(decoder_sizes, "_CORE", tmp_path)
    assert decoder_sizes._decoder_functions("toy") == ["vc_toy_conceal", "vc_toy_decode"]
    size = decoder_sizes.count_decoder_size("toy").bytes
    assert size is not None and 1000 < size < 1100
    (tmp_path / "two.c").write_text("int vc_toy_encode(int x) { return }\n")
    with pytest.raises(click.ClickException, match="cannot be compiled"):
        decoder_sizes.count_decoder_size("toy")


def test_codecs_outside_the_core() -> None:
    opus = decoder_sizes.count_decoder_size("opus")
    assert opus.bytes is not None and opus.bytes > 100_000
    assert "libopus" in opus.note and "encoder included" in opus.note
    assert decoder_sizes.count_decoder_size("flac").bytes is None


@needs_ziglang
def test_the_command_writes_the_file_or_says_why_not(tmp_path: Path) -> None:
    done = CliRunner().invoke(decoder_sizes.main, ["--out", str(tmp_path / "sizes.json")])
    assert done.exit_code == 0, done.output
    assert set(json.loads((tmp_path / "sizes.json").read_text())) == set(measured_codecs())
    done = CliRunner().invoke(decoder_sizes.main, ["--out", str(tmp_path / "missing" / "sizes.json")])
    assert done.exit_code == 1 and "cannot be written" in done.output
