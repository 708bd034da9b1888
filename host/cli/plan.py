"""The subcommand `plan`: chooses how each texture of a scene is coded, writes the plan, and says why."""

import json
from pathlib import Path

import click
from msgspec import structs

from vibrocast import extras, progress
from vibrocast.host.cli.options import INPUT
from vibrocast.host.cli.planned import play as play_plan
from vibrocast.host.printable import plain

FORECAST_CSV, FORECAST_JSON = "forecast.csv", "forecast.json"


@click.command()
@click.argument("scene_path", metavar="SCENE.toml", type=INPUT)
@click.option(
    "--out", type=click.Path(file_okay=False, path_type=Path), required=True, help="Folder for what is written."
)
@click.option("--play", "plays", is_flag=True, help="Play the plan, and compare measurement and forecast.")
@click.option("--json", "as_json", is_flag=True, help="Print the forecasts as JSON.")
def plan(scene_path: Path, out: Path, plays: bool, as_json: bool) -> None:
    """Choose how each texture of a scene is coded, with no more than it needs.

    Writes plan.toml, a picture of all that was measured (plan.png), and its tables (candidates.csv, bands.csv); with
    --play also forecast.csv and forecast.json. What is then measured more than 10 % off its forecast fails.
    """
    extras.require("bench")
    from vibrocast.host import planner
    from vibrocast.host.planner import page

    scene = planner.read_scene(scene_path)
    with progress.bar("planning") as update:
        planned, choices = planner.plan(scene, update)
    out.mkdir(parents=True, exist_ok=True)
    planner.write_plan(out / page.PLAN, planned)
    page.write_tables(out, choices)
    page.draw(out / page.PICTURE, scene, choices)
    if as_json and not plays:
        click.echo(json.dumps({each.name: structs.asdict(each.forecast) for each in planned.textures}, indent=2))
    if not as_json:
        for choice, texture in zip(choices, planned.textures, strict=True):
            for line in page.summary(choice, texture).splitlines():
                click.echo(plain(line))
        click.echo(str(out / page.PLAN))
    if plays:
        # From the file, which says it all.
        written = planner.read_plan(out / page.PLAN)
        play_plan(written, (), out / FORECAST_JSON, out / FORECAST_CSV, as_json)
