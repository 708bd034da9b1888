"""Subcommands that train and export models."""

from vibrocast.host.cli.commands import Subcommand

CLI = "vibrocast.export.cli"
COMMANDS = (
    Subcommand("train", "Learned codecs", f"{CLI}.train:train", "Train a model from a TOML configuration.", "train"),
    Subcommand(
        "export",
        "Learned codecs",
        f"{CLI}.export:export",
        "Export a checkpoint: ONNX graphs, model image and card.",
        "train",
    ),
    Subcommand("keys", "Controllers", f"{CLI}.keys:keys", "Make keys, sign model images and check signatures."),
)
