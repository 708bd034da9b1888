"""Key files: what OpenSSL writes, the vector of RFC 8410, permissions, and files that hold no key."""

import base64
import shutil
import stat
import subprocess
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vibrocast.errors import InputError
from vibrocast.firmware import keys

# RFC 8410, sections 10.1 and 10.3.
PRIVATE_PEM = """-----BEGIN PRIVATE KEY-----
MC4CAQAwBQYDK2VwBCIEINTuctv5E1hK1bbY8fdp+K06/nwoy/HU++CXqI9EdVhC
-----END PRIVATE KEY-----
"""
PUBLIC_PEM = """-----BEGIN PUBLIC KEY-----
MCowBQYDK2VwAyEAGb9ECWmEzf6FQbrBZ9w7lshQhqowtrbLDFw4rXAxZuE=
-----END PUBLIC KEY-----
"""
SMALL_ORDER = [bytes(32), (1).to_bytes(32, "little"), bytes.fromhex("ec" + "ff" * 30 + "7f")]
"""Points of order 4, 1 and 2: y = 0, 1 and -1."""


def text_of(kind: str, der: bytes) -> str:
    return f"-----BEGIN {kind} KEY-----\n{base64.b64encode(der).decode()}\n-----END {kind} KEY-----\n"


def test_files_of_rfc_8410_are_read_and_written(tmp_path: Path) -> None:
    private, public = tmp_path / "key.pem", tmp_path / "key.pub.pem"
    private.write_text(PRIVATE_PEM)
    public.write_text(PUBLIC_PEM)
    key = keys.read_private_key(private)
    assert keys.public_key(key) == keys.read_public_key(public) == keys.read_public_key(private)
    written = tmp_path / "written.pem"
    keys.write_private_key(written, key)
    keys.write_public_key(public, keys.public_key(key))
    assert (written.read_text(), public.read_text()) == (PRIVATE_PEM, PUBLIC_PEM)
    assert stat.S_IMODE(written.stat().st_mode) == 0o600
    with pytest.raises(FileExistsError):
        keys.write_private_key(written, bytes(32))


@pytest.mark.skipif(shutil.which("openssl") is None, reason="openssl is not installed")
def test_openssl_reads_and_writes_the_same_files(tmp_path: Path) -> None:
    subprocess.run(["openssl", "genpkey", "-algorithm", "ed25519", "-out", tmp_path / "key.pem"], check=True)
    key = keys.read_private_key(tmp_path / "key.pem")
    (tmp_path / "message").write_bytes(b"message")
    files = "-inkey", tmp_path / "key.pem", "-in", tmp_path / "message"
    sign = subprocess.run(["openssl", "pkeyutl", "-sign", "-rawin", *files], check=True, capture_output=True)
    assert keys.sign(key, b"message") == sign.stdout


@pytest.mark.parametrize(
    "content",
    [
        "-----BEGIN ENCRYPTED PRIVATE KEY-----\nMC4CAQAw\n-----END ENCRYPTED PRIVATE KEY-----\n",
        PRIVATE_PEM.replace("PRIVATE", "PUBLIC"),
        PUBLIC_PEM.replace("PUBLIC", "PRIVATE"),
        PUBLIC_PEM.replace("MCow", "MCox"),
        PUBLIC_PEM.replace("ZuE=", "Zu"),
        PUBLIC_PEM.replace("ZuE=", "ZuEA"),
        PUBLIC_PEM[:-20],
        PUBLIC_PEM + PUBLIC_PEM,
        PUBLIC_PEM + "\u00e9",
        "-----BEGIN ",
        "",
        "x" * 2000,
        "-----BEGIN " + "x" * 2000,
    ],
)
def test_other_files_are_rejected(content: str, tmp_path: Path) -> None:
    path = tmp_path / "key.pem"
    path.write_text(content, encoding="utf-8")
    for read in (keys.read_private_key, keys.read_public_key):
        with pytest.raises(InputError):
            read(path)


@given(st.binary(max_size=300))
def test_any_bytes_are_a_key_or_rejected(data: bytes) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(keys, "read_input", lambda *_: data)
        for read in (keys.read_private_key, keys.read_public_key):
            with pytest.raises(InputError):
                read(Path("key.pem"))


def test_a_public_key_signs_nothing(tmp_path: Path) -> None:
    path = tmp_path / "key.pub.pem"
    path.write_text(PUBLIC_PEM)
    with pytest.raises(InputError, match="signs nothing"):
        keys.read_private_key(path)


@pytest.mark.parametrize("key", SMALL_ORDER)
def test_keys_for_which_anyone_can_sign_are_rejected(key: bytes, tmp_path: Path) -> None:
    path = tmp_path / "key.pub.pem"
    path.write_text(text_of("PUBLIC", bytes.fromhex("302a300506032b6570032100") + key))
    with pytest.raises(InputError, match="anyone can sign"):
        keys.read_public_key(path)


def test_no_new_key_is_like_another() -> None:
    assert len({keys.new_private_key() for _ in range(100)}) == 100
