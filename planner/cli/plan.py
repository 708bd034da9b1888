"""The subcommand `plan`: chooses how each texture of a scene is coded, says why, and plays what it chose."""

from collections.abc import Sequence
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
from vibrocast.host.cli.sections import SectionedCommand
from vibrocast.host.report import write_json
from vibrocast.planner import choose, page, playing
from vibrocast.planner.choose import TextureChoice
from vibrocast.planner.scene import Scene, read_scene

CANDIDATES, PLAN, FORECAST = "candidates.csv", "plan.json", "forecast.json"


@click.command(
    cls=SectionedCommand,
    epilog="vibrocast plan examples/scenes/glove.toml\nvibrocast plan examples/scenes/glove.toml --out planned --play",
)
@click.argument("file", metavar="SCENE.toml", type=INPUT)
@click.option("--out", type=FOLDER, help="Folder for choices, streams and candidates.")
@click.option("--upload", "uploads", is_flag=True, help="Upload the models that the choices need.")
@click.option("--play", "plays", is_flag=True, help="Play the choices, and compare measurement with forecast.")
@click.option(
    "--texture", "names", multiple=True, metavar="NAME", help="Texture to plan; may be repeated. Default: all."
)
@click.option(
    "--device",
    "addresses",
    multiple=True,
    callback=lambda ctx, parameter, values: tuple(checked_address(ctx, parameter, value) for value in values),
    metavar="ADDRESS",
    help="Address of a controller. Default: the scene's.",
)
def plan(
    file: Path, out: Path | None, uploads: bool, plays: bool, names: tuple[str, ...], addresses: tuple[str, ...]
) -> None:
    """Choose the cheapest codec settings that meet your requirements.

    The command prints the choice for each texture of the scene with its reason, and the three nearest alternatives.
    --out writes the choices (plan.json), the coded textures (.vct) and all candidates (candidates.csv).

    --play prints each forecast next to its measurement; --out then also writes both to forecast.json. If one differs
    from the other by more than 10 %, or a level by more than 1 dB, the command fails. --json with --play prints the
    measurements only.

    Give one --device for each controller, in the order of the scene.
    """
    if addresses and not (uploads or plays):
        raise click.UsageError("--device says where to play; add --play or --upload")
    scene = read_scene(file).only(names)
    reached = _at(scene, addresses)
    with progress.bar("planning") as update:
        choices = choose.plan(scene, update)
    documents = [page.document(scene.asked, choice) for choice in choices]
    if not wants_json():
        click.echo("\n\n".join(page.summary(scene.asked, choice) for choice in choices))
    if out is not None:
        _write(out, choices, documents)
    if uploads:
        _upload(reached, choices)
    answer(documents)
    if plays:
        trace_failure(out and out / "plan.pcapng")
        _play(reached, choices, out)


def _write(out: Path, choices: Sequence[TextureChoice], documents: Sequence[object]) -> None:
    """Write the choices with their streams and all candidates, and print the names of the files."""
    out.mkdir(parents=True, exist_ok=True)
    write_json(out / PLAN, documents)
    page.write_candidates(out / CANDIDATES, choices)
    streams = {f"{choice.name}.vct": choice for choice in choices}
    for name, choice in streams.items():
        choice.encode().stream.save(out / name)
    if not wants_json():
        click.echo(f"\n{plain(str(out))}: {plain(', '.join([PLAN, CANDIDATES, *streams]))}")


def _at(scene: Scene, addresses: Sequence[str]) -> Scene:
    """Return a scene whose controllers are at other addresses, in its order. Raises click.UsageError."""
    if not addresses:
        return scene
    if len(scene.controllers) != len(addresses):
        raise click.UsageError(
            f"the scene has {len(scene.controllers)} controllers, and --device is given {len(addresses)} times; give "
            "one for each in the scene's order, or write the addresses into the scene"
        )
    pairs = zip(scene.controllers, addresses, strict=True)
    return replace(scene, controllers=tuple(structs.replace(each, address=to) for each, to in pairs))


def _upload(scene: Scene, choices: Sequence[TextureChoice]) -> None:
    """Upload to each controller the model that its textures need. Raises InputError where they need several."""
    needed: dict[str, set[str]] = {controller.name: set() for controller in scene.controllers}
    for choice in choices:
        if choice.chosen.measured.model is not None:
            needed[choice.subject.texture.controller].add(choice.chosen.measured.model)
    for name, its_models in needed.items():
        if len(its_models) > 1:
            raise InputError(
                f"{name} runs one model at a time, and its textures need {' and '.join(sorted(its_models))}; plan one "
                "by one with --texture, or play simulated controllers, which --play reloads"
            )
    for name, its_models in needed.items():
        for model in its_models:
            upload(models.find(model), scene.controller(name).address, name)
    if not any(needed.values()):
        tell("no texture needs a model; nothing to upload")


def _play(scene: Scene, choices: Sequence[TextureChoice], out: Path | None) -> None:
    """Play the choices; print forecast and measured, and write them. Raises click.ClickException where they differ."""
    with progress.bar("playing") as update:
        played = playing.play(scene, choices, update)
    documents = [each.document() for each in played]
    if out is not None:
        write_json(out / FORECAST, documents)
    answer(documents)
    if not wants_json():
        for row in (row for each in played for row in each.rows()):
            click.echo(plain(row.line()))
    failures = [failure for each in played for failure in each.failures()]
    if failures:
        raise click.ClickException(plain("; ".join(failures)))
