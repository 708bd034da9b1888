"""The subcommand `keys`: makes keys, signs model images, checks signatures."""

from pathlib import Path

import click

from vibrocast import models
from vibrocast.device_protocol.model_image import MAX_NUMBER
from vibrocast.errors import InputError
from vibrocast.files import atomic_write, plain
from vibrocast.firmware import keys as key_files
from vibrocast.host import uploader
from vibrocast.host.cli.answers import tell
from vibrocast.host.cli.option_types import INPUT, OutputFile, Whole, reject_overwriting
from vibrocast.host.cli.options import chosen_image
from vibrocast.host.cli.sections import SectionedCommand
from vibrocast.host.cli.steps import files_of

KEY_SUFFIX = ".pem"
PUBLIC_SUFFIX = ".pub.pem"

model_argument = click.argument("model", callback=chosen_image)


@click.group()
def keys() -> None:
    """Make keys, sign model images and check signatures.

    Keys are of Ed25519, in PEM files as OpenSSL and MCUboot's imgtool write them.
    """


@keys.command(
    cls=SectionedCommand,
    epilog="vibrocast keys new vendor.pem\nvibrocast keys new vendor.pem --json",
)
@click.argument("key", type=OutputFile(KEY_SUFFIX))
def new(key: Path) -> None:
    """Make a key pair.

    The command writes the private key to KEY, such as vendor.pem, which only you can read. It writes the public key
    next to it, to vendor.pub.pem. A lost private key cannot be made again.
    """
    private_key = key_files.new_private_key()
    public_key = key_files.public_key(private_key)
    public_path = key.with_suffix(PUBLIC_SUFFIX)
    for path in (key, public_path):
        if path.exists():
            raise InputError(f"{path} exists, and a key cannot be made again; name another file")
    key_files.write_private_key(key, private_key)
    try:
        key_files.write_public_key(public_path, public_key)
    except OSError:
        key.unlink()  # so that the same command can be run again
        raise
    shown = public_key.hex()
    tell(f"{public_path}: public key {shown}", file=str(public_path), public_key=shown)


@keys.command(
    cls=SectionedCommand,
    epilog="vibrocast keys show vendor.pub.pem\nvibrocast keys show vendor.pem",
)
@click.argument("key", metavar="KEY", type=INPUT)
def show(key: Path) -> None:
    """Print the public key of a file in hexadecimal digits."""
    public_key = key_files.read_public_key(key).hex()
    tell(public_key, public_key=public_key)


@keys.command(
    cls=SectionedCommand,
    epilog="vibrocast keys sign eva-128-1 --key vendor.pem --number 1 --out signed.vcmi\n"
    "vibrocast keys sign actuator.toml --key vendor.pem --number 2 --out signed.vcmi",
)
@model_argument
@click.option("--key", type=INPUT, metavar="FILE", required=True, help="Private key.")
@click.option(
    "--number",
    type=Whole("number", 1, MAX_NUMBER),
    required=True,
    help="Number of the release; no lower one runs later.",
)
@click.option("--out", type=OutputFile(models.IMAGE_SUFFIX), required=True, help="Signed image.")
def sign(model: models.Model, key: Path, number: int, out: Path) -> None:
    """Sign a model image.

    MODEL is a name that `vibrocast models` lists, a folder of `vibrocast export`, a model image, or an actuator's TOML
    file. Streams of the model play with the signed image as well.
    """
    reject_overwriting([out], [key, *files_of(model)])
    private_key = key_files.read_private_key(key)
    image = uploader.signed(model.image, private_key, number)
    with atomic_write(out) as partial:
        partial.write_bytes(image)
    public_key = key_files.public_key(private_key).hex()
    tell(
        plain(f"{out}: {model.name}, number {number}, by {public_key}"),
        out=str(out),
        model=model.name,
        number=number,
        public_key=public_key,
    )


@keys.command(
    cls=SectionedCommand,
    epilog="vibrocast keys verify signed.vcmi --public-key vendor.pub.pem\n"
    "vibrocast keys verify signed.vcmi --public-key vendor.pub.pem --json",
)
@model_argument
@click.option("--public-key", type=INPUT, metavar="FILE", required=True, help="Public key.")
def verify(model: models.Model, public_key: Path) -> None:
    """Check the signature of a model image.

    MODEL is as for `sign`.
    """
    key = key_files.read_public_key(public_key)
    image = uploader.check_signature(model.image, key)
    tell(
        plain(f"{model.path}: {image.name} {image.version}, number {image.number}, by {key.hex()}"),
        file=str(model.path),
        model=image.name,
        version=image.version,
        number=image.number,
        public_key=key.hex(),
    )
