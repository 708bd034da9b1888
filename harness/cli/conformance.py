"""The subcommand `conformance`: tests a controller against the whole protocol, and writes a report to publish."""

from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

import click
from rich.console import Console
from rich.table import Table

from vibrocast import errors, progress
from vibrocast.files import plain
from vibrocast.host import devices
from vibrocast.host.bench_file import InputSensor, choose_controller, read_bench
from vibrocast.host.cli.answers import add, tell, wants_json
from vibrocast.host.cli.option_types import FOLDER, INPUT
from vibrocast.host.cli.options import device_option
from vibrocast.host.cli.sections import SectionedCommand

if TYPE_CHECKING:
    from vibrocast.harness.conformance import Report
    from vibrocast.harness.sensors import Recorder


@click.command(
    cls=SectionedCommand,
    epilog="vibrocast conformance --quick\nvibrocast conformance --device serial:/dev/ttyACM0 --out report",
)
@device_option
@click.option("--out", type=FOLDER, help="Folder for the report. Default: none is written.")
@click.option("--no-flash", is_flag=True, help="Write no model image; requirements on them are not applicable.")
@click.option("--quick", is_flag=True, help="Leave out tests that take more than a second.")
@click.option(
    "--recorder",
    type=INPUT,
    metavar="FILE",
    help="Real output to compare: a file of a port's DAC codes, or a bench file with a sensor.",
)
def conformance(address: str, out: Path | None, no_flash: bool, quick: bool, recorder: Path | None) -> None:
    """Test a controller against the protocol.

    The requirements are those of docs/reference/protocol.md. The tests play textures, and write the spare slot for
    model images. The image that runs now runs again afterwards.

    The exit code is 0 if the controller conforms, and 1 if it does not. It is 3 if no controller answers, or if it
    was lost in the middle, and 6 if this machine was too busy to decide.
    """
    from vibrocast.harness.conformance import SuiteInterrupted, TappedLink, run_suite

    if out is not None:
        out.mkdir(parents=True, exist_ok=True)  # an error is better known before the tests than after
    real_output = recorder if recorder is None or recorder.suffix != ".toml" else _sensor(recorder, address)
    try:
        with devices.reach(address) as transport:
            with progress.bar("testing") as update:
                report = run_suite(TappedLink(transport, may_flash=not no_flash, recorder=real_output), quick, update)
            _publish(report, out)  # a controller that has died may fail once more where it is closed
    except SuiteInterrupted as interruption:
        add(interruption.report.facts())
        raise


def _sensor(bench_file: Path, address: str) -> "Recorder":
    """Return what records by the sensor of a bench on a controller. Raises InputError."""
    from vibrocast.harness.sensors import recorder

    sensor = choose_controller(read_bench(bench_file), address).sensor
    if not isinstance(sensor, InputSensor) or sensor.kind == "loop-back":
        raise errors.InputError(
            f"{bench_file}: channel 1 of {address} has no accelerometer or laser at an input of this computer; "
            "add one to [[sensors]]"
        )
    return recorder(sensor)


def _publish(report: "Report", out: Path | None) -> None:
    """Print a report, write it into a folder, and exit by its verdict."""
    from vibrocast.harness.conformance import PAGE

    if wants_json():
        add(report.facts())
    else:
        show(report)
    if out is not None:
        report.write(out)
        tell(f"report: {out / PAGE}")
    if not report.conforming:
        code = errors.NO_DEVICE if report.lost_after else errors.HOST_BUSY if report.undecided else errors.FAILED
        add({"error": report.summary, "exit_code": code})
        raise click.exceptions.Exit(code)


def show(report: "Report") -> None:
    """Print how many requirements of each section had which outcome, what failed, and the verdict."""
    from vibrocast.harness.conformance import Outcome

    table = Table("section", *(outcome.value for outcome in Outcome))
    for section, findings in report.sections():
        counts = Counter(finding.outcome for finding in findings)
        table.add_row(section, *(str(counts[outcome] or "") for outcome in Outcome))
    Console().print(table)
    for finding in report.findings:
        if finding.outcome in (Outcome.FAILED, Outcome.UNDECIDED):
            click.echo(f"{finding.outcome.value.upper()}  {finding.requirement.text}\n      {finding.reason}")
    for reason in {finding.reason for finding in report.findings if finding.outcome == Outcome.NOT_TESTED}:
        click.echo(f"{Outcome.NOT_TESTED.value}: {reason}")
    click.echo(f"{plain(report.hello.hardware)}, {plain(report.hello.build)}: {report.summary}")
