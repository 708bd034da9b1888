"""The subcommand `keys`, and controllers with a key: from a new key to a stream that a signed image decodes."""

import errno
import re
import stat
import sys
from collections.abc import Iterator
from pathlib import Path
from unittest.mock import Mock

import pytest

from tests.command import fails, started, succeeds
from vibrocast import models
from vibrocast.device_protocol.model_image import ModelImage, unsigned
from vibrocast.firmware import keys as key_files

MODEL = "mdct-textures"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with two key pairs, vendor and other."""
    made = tmp_path_factory.mktemp("keys")
    for name in ("vendor", "other"):
        succeeds("keys", "new", made / f"{name}.pem")
    return made


@pytest.fixture
def address(folder: Path) -> Iterator[str]:
    """A simulated controller that takes images of the vendor alone."""
    process = started("simulate", "--public-key", folder / "vendor.pub.pem")
    assert process.stdout is not None
    yield process.stdout.readline().strip()
    process.terminate()
    process.communicate(timeout=20)


def sign(folder: Path, number: int, key: str = "vendor", model: str = MODEL) -> Path:
    out = folder / f"{model}-{number}-{key}.vcmi"
    succeeds("keys", "sign", model, "--key", folder / f"{key}.pem", "--number", number, "--out", out)
    return out


def test_a_new_key_is_its_owners_and_is_shown(folder: Path) -> None:
    private, public = folder / "vendor.pem", folder / "vendor.pub.pem"
    assert stat.S_IMODE(private.stat().st_mode) == 0o600
    shown = succeeds("keys", "show", private)
    assert re.fullmatch("[0-9a-f]{64}\n", shown)
    assert succeeds("keys", "show", public) == shown
    assert "exists" in fails(2, "keys", "new", private)
    assert "must end in .pem" in fails(2, "keys", "new", folder / "key")


def test_a_pair_is_made_whole_or_not_at_all(tmp_path: Path) -> None:
    (tmp_path / "key.pub.pem").write_text("")
    assert "exists" in fails(2, "keys", "new", tmp_path / "key.pem")
    assert not (tmp_path / "key.pem").exists()


def test_a_disk_that_holds_no_public_key_keeps_no_private_key(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    full = OSError(errno.ENOSPC, "No space left on device")
    monkeypatch.setattr(key_files, "write_public_key", Mock(side_effect=full))
    assert "No space left" in fails(2, "keys", "new", tmp_path / "key.pem")
    assert list(tmp_path.iterdir()) == []


def test_an_image_is_signed_and_verified(folder: Path) -> None:
    path = sign(folder, 5)
    image = models.find(MODEL).image
    assert unsigned(path.read_bytes()) == image
    assert ModelImage.unpack(path.read_bytes()).number == 5
    assert f"{MODEL} 1, number 5" in succeeds("keys", "verify", path, "--public-key", folder / "vendor.pub.pem")
    assert "not by the key" in fails(2, "keys", "verify", path, "--public-key", folder / "other.pub.pem")
    assert "has no signature" in fails(2, "keys", "verify", MODEL, "--public-key", folder / "vendor.pub.pem")


def test_a_second_signature_takes_the_place_of_the_first(folder: Path) -> None:
    path, out = sign(folder, 5), folder / "again.vcmi"
    succeeds("keys", "sign", path, "--key", folder / "other.pem", "--number", 6, "--out", out)
    assert len(out.read_bytes()) == len(path.read_bytes())
    succeeds("keys", "verify", out, "--public-key", folder / "other.pub.pem")


def test_what_cannot_be_signed_is_an_error(folder: Path) -> None:
    out = folder / "out.vcmi"
    key, public = folder / "vendor.pem", folder / "vendor.pub.pem"
    assert "signs nothing" in fails(2, "keys", "sign", MODEL, "--key", public, "--number", 1, "--out", out)
    for number in (0, 1 << 32, -1, "x"):
        assert "cannot be used" in fails(2, "keys", "sign", MODEL, "--key", key, "--number", number, "--out", out)
    assert "same file" in fails(
        2, "keys", "sign", sign(folder, 1), "--key", key, "--number", 1, "--out", sign(folder, 1)
    )
    assert "begin with" in fails(2, "keys", "sign", MODEL, "--key", sign(folder, 1), "--number", 1, "--out", out)
    assert not out.exists()


@pytest.mark.skipif(sys.platform == "win32", reason="the address is a pseudo-terminal")
def test_a_controller_with_a_key_from_end_to_end(folder: Path, address: str) -> None:
    key = succeeds("keys", "show", folder / "vendor.pem").strip()
    status = succeeds("status", "--device", address)
    assert f"public key     {key}" in status
    assert "signed images: yes" in status
    assert "has no signature" in fails(2, "flash", MODEL, "--device", address)
    assert "not by the key" in fails(2, "flash", sign(folder, 9, "other"), "--device", address)
    assert "confirmed; number 3, signature checked" in succeeds("flash", sign(folder, 3), "--device", address)
    assert "number 2, and 3 was confirmed" in fails(1, "flash", sign(folder, 2), "--device", address)
    assert "confirmed, 71407e2734ca090c, number 3" in succeeds("status", "--device", address)


def test_a_controller_without_a_key_says_so() -> None:
    status = succeeds("status")
    assert "public key     none: model images need no signature" in status
    assert "signed images: no" in status
    assert "confirmed; no signature checked" in succeeds("flash", MODEL)
