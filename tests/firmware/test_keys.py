"""Key files: what OpenSSL writes, the vector of RFC 8410, permissions, and files that hold no key."""

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
# A key of another kind: NIST P-256.
P256_PEM = """-----BEGIN PUBLIC KEY-----
MFkwEwYHKoZIzj0CAQYIKoZIzj0DAQcDQgAEaxfR8uEsQkf4vOblY6RA8ncDfYEt
6zOg9KE5RdiYwpZP40Li/hp/m47n60p8D54WK84zV2sxXs7LtkBoN79R9Q==
-----END PUBLIC KEY-----
"""
# The encodings of points of order 1, 2, 4 and 8, those of y at or above 2^255 - 19 too, as libsodium lists them.
SMALL_ORDER = [
    "00" * 32,
    "01" + "00" * 31,
    "26e8958fc2b227b045c3f489f2ef98f0d5dfac05d3c63339b13802886d53fc05",
    "c7176a703d4dd84fba3c0b760d10670f2a2053fa2c39ccc64ec7fd7792ac037a",
    *(low + "ff" * 30 + "7f" for low in ("ec", "ed", "ee")),
]
# RFC 8032, section 7.1, TEST 3: private key, public key, message, signature.
VECTOR = (
    "c5aa8df43f9f837bedb7442f31dcb7b166d38535076f094b85ce3a2e0b4458f7",
    "fc51cd8e6218a1a38da47ed00230f0580816ed13ba3303ac5deb911548908025",
    "af82",
    "6291d657deec24024827e69c3abe01a30ce548a284743a445e3680d7db5ac3ac18ff9b538d16f290ae67f760984dc6594a7c15e9716ed28dc027beceea1ec40a",
)


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
        P256_PEM,
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


@pytest.mark.parametrize("key", SMALL_ORDER)
@pytest.mark.parametrize("sign", [0, 0x80])
def test_keys_for_which_anyone_can_sign_are_rejected(key: str, sign: int, tmp_path: Path) -> None:
    path = tmp_path / "key.pub.pem"
    point = bytearray.fromhex(key)
    point[-1] |= sign
    keys.write_public_key(path, bytes(point))
    with pytest.raises(InputError, match="anyone can sign"):
        keys.read_public_key(path)


def test_signatures_are_those_of_rfc_8032() -> None:
    private, public, message, signature = map(bytes.fromhex, VECTOR)
    assert (keys.public_key(private), keys.sign(private, message)) == (public, signature)
    assert keys.is_signed(signature, public, message)
    assert not keys.is_signed(signature, public, message + b"x")
