"""The subcommand `plan`: chooses how each texture of a scene is coded, says why, and plays what it chose."""

import tempfile
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import click
from msgspec import structs

from vibrocast import models, progress
from vibrocast.errors import InputError
from vibrocast.files import plain
from vibrocast.host.cli.answers import answer, tell, wants_json
from vibrocast.host.cli.devices import upload
from vibrocast.host.cli.failure_trace import trace_failure
from vibrocast.host.cli.option_types import FOLDER, INPUT
from vibrocast.host.cli.options import checked_address
from vibrocast.host.report import write_json
from vibrocast.planner import choose, comparison, page, playing
from vibrocast.planner.plan_file import Plan, is_plan, read_plan, write_plan
from vibrocast.planner.scene import read_scene

FORECAST_CSV, FORECAST_JSON = "forecast.csv", "forecast.json"


@click.command()
@click.argument("file", metavar="FILE.toml", type=INPUT)
@click.option("--out", type=FOLDER, help="Write plan, streams, picture and tables into this folder.")
@click.option("--upload", "uploads", is_flag=True, help="Upload the models that the plan needs.")
@click.option("--play", "plays", is_flag=True, help="Play the plan, and compare measurement with forecast.")
@click.option("--texture", "names", multiple=True, metavar="NAME", help="Play this texture. Default: all.")
@click.option(
    "--device",
    "addresses",
    multiple=True,
    callback=lambda ctx, parameter, values: tuple(checked_address(ctx, parameter, value) for value in values),
    metavar="ADDRESS",
    help="Replace a controller's address. Default: the file's.",
)
def plan(
    file: Path, out: Path | None, uploads: bool, plays: bool, names: tuple[str, ...], addresses: tuple[str, ...]
) -> None:
    """Choose the cheapest codec settings that meet your requirements.

    FILE.toml is a scene, or a plan that --out wrote before. For a scene, the command prints the choice for each texture
    with its reason, and the three nearest alternatives. --out writes the plan (plan.toml), the coded textures (.vct),
    all candidates (candidates.csv, plan.png) and the bands worth coding (bands.csv).

    --play prints each forecast next to its measurement; --out then also writes both to forecast.csv and forecast.json.
    If one differs from the other by more than 10 %, or a level by more than 1 dB, the command fails. --json with --play
    prints the measurements only.

    Give one --device for each controller, in the order of the file.
    """
    if (names or addresses) and not (uploads or plays):
        raise click.UsageError("--texture and --device say how to play; add --play or --upload")
    with ExitStack() as stack:
        if is_plan(file):
            if not (uploads or plays):
                raise click.UsageError(f"{file} is a plan; add --play or --upload, or give a scene")
            planned = read_plan(file)
        else:
            folder = out or Path(stack.enter_context(tempfile.TemporaryDirectory()))
            planned = _planned(file, folder, out is not None)
        planned = _at(planned, addresses)
        if uploads:
            _upload(planned)
        if plays:
            trace_failure(out and out / "plan.pcapng")
            _play(planned, names, out)


def _planned(scene_path: Path, folder: Path, keeps: bool) -> Plan:
    """Plan a scene, print the choices, and return the plan as its file in a folder says; `keeps`: with all outputs."""
    scene = read_scene(scene_path)
    with progress.bar("planning") as update:
        planned, choices = choose.plan(scene, update)
    folder.mkdir(parents=True, exist_ok=True)
    write_plan(folder / page.PLAN, planned)
    written = read_plan(folder / page.PLAN)
    answers = list(zip(choices, planned.textures, strict=True))
    if wants_json():
        answer([page.document(choice, texture) for choice, texture in answers])
    else:
        click.echo("\n\n".join(page.summary(scene.asked, choice, texture) for choice, texture in answers))
    if keeps:
        page.write_tables(folder, choices)
        page.draw(folder / page.PICTURE, scene, choices)
        streams = {texture.name: folder / f"{texture.name}.vct" for texture in written.textures}
        for texture in written.textures:
            texture.encode().stream.save(streams[texture.name])
        if not wants_json():
            files = [page.PLAN, page.PICTURE, page.CANDIDATES, page.BANDS, *(path.name for path in streams.values())]
            click.echo(f"\n{plain(str(folder))}: {plain(', '.join(files))}")
    return written


def _at(planned: Plan, addresses: Sequence[str]) -> Plan:
    """Return a plan whose controllers are at other addresses, in its order. Raises click.UsageError."""
    if not addresses:
        return planned
    if len(planned.controllers) != len(addresses):
        raise click.UsageError(
            f"the plan has {len(planned.controllers)} controllers, and --device is given {len(addresses)} times; give "
            "one for each in the plan's order, or write the addresses into the plan"
        )
    pairs = zip(planned.controllers, addresses, strict=True)
    return replace(planned, controllers=tuple(structs.replace(each, address=to) for each, to in pairs))


def _upload(planned: Plan) -> None:
    """Upload to each controller the model that its textures need. Raises InputError where they need several."""
    needed = [
        (controller, name)
        for controller in planned.controllers
        for name in sorted(
            {each.model for each in planned.textures if each.controller == controller.name and each.model}
        )
    ]
    names = [controller.name for controller, _ in needed]
    for controller, _ in needed:
        if names.count(controller.name) > 1:
            several = " and ".join(name for each, name in needed if each == controller)
            raise InputError(
                f"{controller.name} runs one model at a time, and its textures need {several}; plan a scene for each "
                "model, or play simulated controllers, which --play reloads"
            )
    for controller, name in needed:
        upload(models.find(name), controller.address, controller.name)
    if not needed:
        tell("no texture needs a model; nothing to upload")


def _play(planned: Plan, names: Sequence[str], out: Path | None) -> None:
    """Play textures of a plan; print forecast and measured, and write them as JSON and CSV.

    Raises click.ClickException where something was not as planned.
    """
    failure: playing.PartlyPlayedError | None = None
    with progress.bar("playing") as update:
        try:
            played = playing.play(planned, names, progress=update)
        except playing.PartlyPlayedError as error:
            played, failure = error.played, error
    compared = comparison.rows(played)
    documents = [comparison.document(each) for each in played]
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        write_json(out / FORECAST_JSON, documents)
        comparison.write_csv(out / FORECAST_CSV, compared)
    answer(documents)
    for line in () if wants_json() else map(plain, comparison.lines(compared)):
        click.echo(line)
    told = comparison.failures(played, compared) + ([] if failure is None else [str(failure)])
    if told:
        raise click.ClickException(plain("; ".join(told)))
