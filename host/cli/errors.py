"""The errors of the `vibrocast` command: what the library raises, in words for a person and with an exit code."""

import errno
import re
from collections.abc import Mapping

import click

from vibrocast import extras
from vibrocast.host.cli import exit_codes

DISK_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


class DeviceFailure(click.ClickException):
    """The device, or this program, failed."""

    exit_code = exit_codes.FAILED


class NoDevice(click.ClickException):
    """No controller answers at the address, or the connection was lost for good."""

    exit_code = exit_codes.NO_DEVICE


def option_names(command: click.Command | None) -> dict[str, str]:
    """Return the options of a subcommand by the parameters that the library's errors name."""
    options = [option for parameter in (command.params if command else ()) for option in parameter.opts]
    named = {option.removeprefix("--").replace("-", "_"): option for option in options if option.startswith("--")}
    return {**named, "highpass_hz=None": "--keep-dc"}


def explained(error: Exception, options: Mapping[str, str]) -> click.ClickException:
    """Return the exception that tells a person what went wrong and what to do, with its exit code.

    `options`: as of `option_names`; they take the place of parameters, which the library's errors put in backticks.
    """
    # Only an error needs these modules; a subcommand has loaded most of them.
    from vibrocast import codec, models, textures
    from vibrocast.device_protocol.coded_stream import StreamError
    from vibrocast.device_protocol.messages import MessageError
    from vibrocast.device_protocol.model_image import ModelImageError
    from vibrocast.device_protocol.trace import TraceError
    from vibrocast.device_protocol.transports import TransportError
    from vibrocast.files import InputFileError
    from vibrocast.firmware.native_core import CoreError
    from vibrocast.host.cli.options import BadInput
    from vibrocast.host.controller import ConnectionLost, ControllerError

    device_errors = (ControllerError, TransportError, MessageError)
    input_errors = (
        textures.TextureError,
        codec.CodecError,
        InputFileError,
        extras.MissingExtraError,
        StreamError,
        TraceError,
        ModelImageError,
        models.ModelError,
        OSError,
        MemoryError,
        CoreError,
    )
    text = re.sub("`([a-z_=A-Z]+)`", lambda quoted: options.get(quoted[1], quoted[0]), str(error))
    if isinstance(error, OSError) and error.errno in DISK_FULL:
        text = f"{error.filename or 'the output'}: {error.strerror}; free some space, or write elsewhere"
    elif isinstance(error, OSError) and error.filename:
        text = f"{error.filename}: {error.strerror}; check the name and your permissions"
    if isinstance(error, MemoryError):
        text = "not enough memory for this recording; cut it into shorter ones"
    if not isinstance(error, (*input_errors, *device_errors)):
        text = f"unexpected {type(error).__name__}: {text}; `vibrocast --debug ...` shows where, please report it"
    # A TransportError is an OSError too.
    bad_input = isinstance(error, input_errors) and not isinstance(error, device_errors)
    if isinstance(error, (TransportError, ConnectionLost)):
        return NoDevice(text)
    return BadInput(text) if bad_input else DeviceFailure(text)
