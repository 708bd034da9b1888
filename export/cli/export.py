"""The subcommand `export`: a checkpoint becomes graphs, a model image and a card, in one folder."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import click
import numpy as np

from vibrocast import models, progress
from vibrocast.device_protocol.model_image import MAX_NUMBER
from vibrocast.errors import InputError
from vibrocast.files import atomic_folder
from vibrocast.firmware.keys import read_private_key
from vibrocast.host import uploader
from vibrocast.host.cli.answers import tell
from vibrocast.host.cli.option_types import FOLDER, INPUT, Whole
from vibrocast.host.cli.options import command_run
from vibrocast.host.cli.sections import MORE, SectionedCommand, section

FILES = {models.CARD, "card.md", "curves.csv", "curves.png", models.ANALYSIS, "synthesis.onnx"}
"""The files in the folder of a model, in addition to its image."""


def checked_name(ctx: click.Context, param: click.Parameter, value: str | None) -> str | None:
    """Return a model's name, or raise click.BadParameter for one that makes no good file name."""
    if value is not None and not re.fullmatch(r"[a-z0-9][a-z0-9-]{0,40}", value):
        raise click.BadParameter(f"{value!r} names no file; use at most 41 small letters, digits, hyphens", ctx, param)
    return value


def reject_replacing_others(folder: Path) -> None:
    """Raise InputError for a folder that holds anything but a model. Raises OSError where it cannot be looked into."""
    held = {path.name for path in folder.iterdir() if path.suffix != models.IMAGE_SUFFIX} if folder.exists() else set()
    if held and (models.CARD not in held or held - FILES):
        raise InputError(f"{folder} holds other files than a model's, and would be replaced; give another --out")


@click.command(
    cls=SectionedCommand,
    epilog="vibrocast export trained/eva/checkpoint.pt\n"
    "vibrocast export trained/eva/checkpoint.pt --name mine --sign vendor.pem 1",
)
@click.argument("checkpoint", type=INPUT)
@click.option(
    "--name", callback=checked_name, metavar="NAME", help="Name of the model. Default: the name of its training."
)
@section(
    MORE,
    click.option(
        "--version",
        "model_version",
        metavar="VERSION",
        default="1",
        help="Version of the model.",
    ),
)
@click.option(
    "--runtime",
    type=click.Choice(("core", "onnx", "both")),
    default="core",
    help="Content: the integer network (core), the ONNX graph, or both.",
)
@section(
    MORE,
    click.option(
        "--data",
        "data_folder",
        type=INPUT,
        metavar="FOLDER",
        default=".",
        help="Folder of the training's data.",
    ),
    click.option(
        "--training-command",
        metavar="COMMAND",
        help="Command of the training, for the card. Default: `vibrocast train NAME.toml`.",
    ),
)
@click.option(
    "--sign",
    "signing",
    type=(INPUT, Whole("number", 1, MAX_NUMBER)),
    metavar="KEY NUMBER",
    help="Private key that signs the image, and number of the release.",
)
@click.option("--out", type=FOLDER, help="Folder of the model. Default: ./NAME.")
def export(
    checkpoint: Path,
    name: str | None,
    model_version: str,
    out: Path | None,
    runtime: Any,
    data_folder: Path,
    training_command: str | None,
    signing: tuple[Path, int] | None,
) -> None:
    """Export a checkpoint: ONNX graphs, model image and card.

    The training's data set the ranges of the integers. The card measures the model on the data that the training held
    back.

    The command writes the folder as a whole, and replaces a folder that holds a model. No release with a lower number
    runs after one that is signed.
    """
    from vibrocast.export import configuration, model_card, package, training_curves, training_data
    from vibrocast.export.checkpoint import load

    private_key = None if signing is None else read_private_key(signing[0])
    loaded = load(checkpoint)
    try:
        trained_as = configuration.parsed(loaded.training)
    except InputError as error:
        raise models.ModelError(
            f"{checkpoint}: the configuration in it is damaged: {error}; train the model again"
        ) from error
    if (done := loaded.progress["step"]) < trained_as.training.steps:
        raise models.ModelError(
            f"{checkpoint}: its training was cut at step {done} of {trained_as.training.steps}; continue it with "
            "`vibrocast train --resume`"
        )
    name = name or trained_as.name
    out = out or Path(name)
    reject_replacing_others(out)
    # An error is better known before the work than after.
    out.parent.mkdir(parents=True, exist_ok=True)
    commands = training_command or f"vibrocast train {trained_as.name}.toml", command_run()
    with progress.bar("exporting") as update:
        update(0, "reading the training's data")
        traces = training_data.load(trained_as.sources, data_folder, trained_as.training.rate_hz)
        trained, held_back = training_data.split(traces, trained_as.held_back, trained_as.seed)
        signals = [trace.samples.astype(np.float64) for trace in trained]
        update(0, "integers")
        made = package.make(loaded, name, model_version, runtime, signals)
        if private_key is not None and signing is not None:
            made = replace(made, image=uploader.signed(made.image, private_key, signing[1]))
        card = model_card.made(loaded, made, trained, held_back, commands, update)
    with atomic_folder(out) as partial:
        for file, data in {**made.files, **training_curves.files(loaded.curves)}.items():
            (partial / file).write_bytes(data)
        (partial / models.CARD).write_text(model_card.as_json(card), encoding="utf-8")
        (partial / "card.md").write_text(model_card.as_markdown(card), encoding="utf-8")
    point = card["results"]["point"]
    tell(
        f"{out}: {name}, image of {len(made.image)} bytes, {point['snr_db']:.1f} dB at "
        f"{point['bits_per_sample']:.2f} bit/sample",
        out=str(out),
        model=name,
        image_bytes=len(made.image),
        **point,
    )
