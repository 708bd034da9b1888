"""Options that describe an analogue sensor, for `record` and `measure`."""

import click

from vibrocast.errors import InputError
from vibrocast.host.cli.option_types import positive
from vibrocast.textures.sensitivity import EXAMPLES, Sensitivity, parse


def parsed_sensitivity(ctx: click.Context, param: click.Parameter, value: str | None) -> Sensitivity | None:
    """Return the sensitivity of a sensor, or raise click.BadParameter."""
    try:
        return None if value is None else parse(value)
    except InputError as error:
        raise click.BadParameter(str(error), ctx, param) from error


sensitivity_option = click.option(
    "--sensitivity",
    callback=parsed_sensitivity,
    metavar="VALUE/UNIT",
    help=f"Give the sensor's sensitivity: {EXAMPLES}.",
)
volts_option = click.option(
    "--volts-full-scale",
    type=positive("V"),
    help="Give the volts at the input that are digital full scale.",
)
