"""The subcommand `conformance`: tries a controller on all that the protocol asks, and writes a report to publish."""

import datetime
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

import click
from rich.console import Console
from rich.table import Table

from vibrocast import extras, progress
from vibrocast.device_protocol.transports import TransportError
from vibrocast.host import devices
from vibrocast.host.cli.options import BadInput, device_option
from vibrocast.host.plain import plain

if TYPE_CHECKING:
    from vibrocast.host.conformance.report import Report


@click.command()
@device_option
@click.option("--out", type=click.Path(file_okay=False, path_type=Path), help="Folder for the report.")
@click.option("--no-flash", is_flag=True, help="Write no slot for model images; what needs that is not offered.")
@click.option("--quick", is_flag=True, help="Leave out what takes more than a second.")
@click.option("--date", "dated", is_flag=True, help="Put today's date into the report.")
def conformance(address: str, out: Path | None, no_flash: bool, quick: bool, dated: bool) -> None:
    """Test a controller against docs/protocol.md.

    It plays textures, and writes the slot for model images that does not run; the image that runs runs again
    afterwards. The exit code is 0 if the controller conforms, 1 if it does not, and 2 if it could not be tried.
    """
    extras.require("bench")
    from vibrocast.host.conformance.judge import NotJudged, judge
    from vibrocast.host.conformance.line import Line
    from vibrocast.host.conformance.report import PAGE, Report

    if out is not None:
        out.mkdir(parents=True, exist_ok=True)  # what cannot be written is better known before than after
    try:
        with devices.reach(address) as transport, progress.shown("trying") as update:
            hello, findings = judge(Line(transport, may_flash=not no_flash), quick, update)
    except (TransportError, NotJudged) as error:
        raise BadInput(str(error)) from error
    left_out = ["what takes more than a second"] * quick + ["what writes a slot for model images"] * no_flash
    date = datetime.date.today().isoformat() if dated else None
    report = Report(hello, tuple(findings), tuple(left_out), date)
    show(report)
    if out is not None:
        report.write(out)
        click.echo(f"report: {out / PAGE}")
    if not report.conforming:
        raise click.exceptions.Exit(1)


def show(report: "Report") -> None:
    """Print how many requirements of each section had which outcome, what failed, and the verdict."""
    from vibrocast.host.conformance.judge import Outcome

    table = Table("section", *(outcome.value for outcome in Outcome))
    for section, findings in report.sections():
        counts = Counter(finding.outcome for finding in findings)
        table.add_row(section, *(str(counts[outcome] or "") for outcome in Outcome))
    Console().print(table)
    for finding in report.findings:
        if finding.outcome == Outcome.FAILED:
            click.echo(f"FAIL  {finding.requirement.text}\n      {finding.reason}")
    for reason in {finding.reason for finding in report.findings if finding.outcome == Outcome.NOT_TRIED}:
        click.echo(f"{Outcome.NOT_TRIED.value}: {reason}")
    click.echo(f"{plain(report.hello.hardware)}, {plain(report.hello.build)}: {report.summary}")
