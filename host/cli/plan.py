"""The subcommand `plan`: chooses how each texture of a scene is coded, and says why."""

from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory

import click

from vibrocast import extras, progress
from vibrocast.host.cli.answers import answer, wants_json
from vibrocast.host.cli.option_types import FOLDER, INPUT
from vibrocast.host.cli.planned import play as play_plan
from vibrocast.host.printable import plain

FORECAST_CSV, FORECAST_JSON = "forecast.csv", "forecast.json"


@click.command()
@click.argument("scene_path", metavar="SCENE.toml", type=INPUT)
@click.option("--out", type=FOLDER, help="Write plan, picture and tables into this folder.")
@click.option("--play", "plays", is_flag=True, help="Play the plan, and compare measurement with forecast.")
def plan(scene_path: Path, out: Path | None, plays: bool) -> None:
    """Choose the cheapest codec settings that meet your requirements.

    Prints the choice for each texture with its reason, and the three nearest alternatives. --out writes the plan
    (plan.toml), all candidates (candidates.csv, plan.png) and the bands worth coding (bands.csv).

    --play prints each forecast next to its measurement; --out then also writes both to forecast.csv and forecast.json.
    If one differs from the other by more than 10 %, the command fails. --json with --play prints the measurements only.
    """
    extras.require("bench")
    from vibrocast.host import planner
    from vibrocast.host.planner import page

    scene = planner.read_scene(scene_path)
    with progress.bar("planning") as update:
        planned, choices = planner.plan(scene, update)
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        planner.write_plan(out / page.PLAN, planned)
        page.write_tables(out, choices)
        page.draw(out / page.PICTURE, scene, choices)
    answers = list(zip(choices, planned.textures, strict=True))
    if wants_json():
        answer([page.document(choice, texture) for choice, texture in answers])
    else:
        click.echo("\n\n".join(page.summary(scene.asked, choice, texture) for choice, texture in answers))
        if out is not None:
            click.echo(f"\n{plain(str(out))}: {page.PLAN}, {page.PICTURE}, {page.CANDIDATES}, {page.BANDS}")
    if plays:
        with ExitStack() as stack:
            folder = out or Path(stack.enter_context(TemporaryDirectory()))
            # From the file, which holds all that the plan says.
            planner.write_plan(folder / page.PLAN, planned)
            written = planner.read_plan(folder / page.PLAN)
            play_plan(written, (), folder / FORECAST_JSON, folder / FORECAST_CSV)
