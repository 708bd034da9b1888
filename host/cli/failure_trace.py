"""The trace of a run that fails: the last frames of all links, in a file that the subcommand names."""

import contextlib
from pathlib import Path

import click

from vibrocast.files import plain

_KEY = "vibrocast.trace_of_failure"


def trace_failure(path: Path | None) -> None:
    """Keep the last frames in a file if the command under way fails; None = nowhere."""
    if path is not None:
        click.get_current_context().meta[_KEY] = path


def keep_trace(ctx: click.Context) -> None:
    """Write the last frames of a run that has failed, where its subcommand has named a file."""
    path = ctx.meta.get(_KEY)
    if path is None:
        return
    from vibrocast.device_protocol.trace import tracer

    if tracer.frames:
        with contextlib.suppress(OSError):  # the failure itself is the news
            tracer.save(path)
            click.echo(f"trace of the last frames: {plain(str(path))}", err=True)
