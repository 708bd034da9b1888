"""The subcommands `codecs` and `models`, which list both."""

import click

from vibrocast import codec, models
from vibrocast.device_protocol.model_image import sha256
from vibrocast.files import plain
from vibrocast.host.cli.answers import answer, wants_json
from vibrocast.host.cli.sections import SectionedCommand
from vibrocast.host.cli.steps import show

_COLUMNS = ("name", "codec", "width", "image bytes", "SNR dB", "bit/sample")


@click.command(
    cls=SectionedCommand,
    epilog="vibrocast codecs\nvibrocast codecs --json",
)
def codecs() -> None:
    """List the codecs and their parameters."""
    facts, lines = {}, {}
    for known in codec.CODECS.values():
        control = "yes" if known.controls_rate else "no, all packets are of one quality"
        about = {"summary": known.summary, "rate control": control}
        lines[known.name] = [f"{name}: {text}" for name, text in about.items()]
        for name, parameter in known.parameters.items():  # named as --setting takes them
            values = f"{parameter.range}; default {parameter.default}"
            about[name] = f"{parameter.meaning} ({values})"
            lines[known.name] += [f"{name}: {parameter.meaning}", f"  {values}"]
        facts[known.name] = about
    show(facts if wants_json() else lines)
    for name, cause in codec.CODECS.failures.items():
        click.echo(
            plain(f"warning: the codec {name} cannot be loaded: {cause}; repair or remove its package"), err=True
        )


@click.command(
    "models",
    cls=SectionedCommand,
    epilog="vibrocast models\nvibrocast models --json",
)
def list_models() -> None:
    """List the shipped models, with rate and quality."""
    if wants_json():
        answer({model.name: {**model.card, "image_sha256": sha256(model.image).hex()} for model in models.shipped()})
        return
    rows = [_COLUMNS, *map(_row, models.shipped())]
    widths = [max(len(row[column]) for row in rows) for column in range(len(_COLUMNS))]
    for row in rows:
        click.echo("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip())


def _row(model: models.Model) -> tuple[str, ...]:
    """Return a model's cells in the table; the last two are means over the recordings that were held back."""
    card = model.card
    point = card.get("results", {}).get("point", {})
    return (
        model.name,
        str(card["codec"]),
        str(card.get("shape", {}).get("width", "")),
        str(len(model.image)),
        *(f"{point[name]:.2f}" if name in point else "" for name in ("snr_db", "bits_per_sample")),
    )
