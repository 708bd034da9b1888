"""The steps of subcommands that take a plan, which replaces their other options."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import click
from click.core import ParameterSource
from msgspec import structs

from vibrocast import models, progress
from vibrocast.host.cli.answers import answer, wants_json
from vibrocast.host.printable import plain
from vibrocast.host.report import write_json

if TYPE_CHECKING:  # modules that plan take a second to load; other commands need not wait for them
    from vibrocast.host.planner import Plan


def read(path: Path, allowed: Sequence[str]) -> "Plan":
    """Read a plan for the command under way, which takes no other option but those.

    The addresses of --device replace those of the plan's controllers, in its order. Raises PlanError, click.UsageError.
    """
    from vibrocast.host.planner import read_plan

    context = click.get_current_context()
    for parameter in context.command.params:
        name = parameter.name or ""
        given = context.get_parameter_source(name) == ParameterSource.COMMANDLINE
        if given and parameter.expose_value and name not in ("plan_path", *allowed):  # --json changes nothing
            label = parameter.opts[-1] if isinstance(parameter, click.Option) else parameter.human_readable_name
            raise click.UsageError(f"{label} contradicts the plan; drop it, or change {path}")
    plan = read_plan(path)
    option = "chosen" if "chosen" in context.params else "address"
    if context.get_parameter_source(option) != ParameterSource.COMMANDLINE:
        return plan
    given = context.params[option]
    addresses = [each.address for each in given] if option == "chosen" else [given]
    if len(plan.controllers) != len(addresses):
        raise click.UsageError(
            f"{path} has {len(plan.controllers)} controllers, and --device is given {len(addresses)} times; give one "
            "for each in the plan's order, or write the addresses into the plan"
        )
    pairs = zip(plan.controllers, addresses, strict=True)
    return replace(plan, controllers=tuple(structs.replace(each, address=address) for each, address in pairs))


def play(plan: "Plan", names: Sequence[str], report: Path | None, table: Path | None = None) -> None:
    """Play textures of a plan, all if none is named; print forecast and measured, and write them as JSON and CSV.

    Raises click.ClickException where something was not as planned.
    """
    from vibrocast.host import planner
    from vibrocast.host.planner import comparison

    failure: planner.PartlyPlayedError | None = None
    with progress.bar("playing") as update:
        try:
            played = planner.play(plan, names, progress=update)
        except planner.PartlyPlayedError as error:
            played, failure = error.played, error
    compared = comparison.rows(played)
    documents = [comparison.document(each) for each in played]
    if report is not None:
        write_json(report, documents)
    if table is not None:
        comparison.write_csv(table, compared)
    answer(documents)
    for line in () if wants_json() else map(plain, comparison.lines(compared)):
        click.echo(line)
    told = comparison.failures(played, compared) + ([] if failure is None else [str(failure)])
    if told:
        raise click.ClickException(plain("; ".join(told)))


def needed_models(path: Path) -> Iterator[tuple[str, str, models.Model]]:
    """Yield name and address of each controller of a plan, and the model that its textures need, where they need one.

    Raises PlanError where they need several, for a controller runs one at a time; ModelError.
    """
    from vibrocast.host.planner import PlanError

    plan = read(path, ("address",))
    for controller in plan.controllers:
        names = sorted({each.model for each in plan.textures if each.controller == controller.name and each.model})
        if len(names) > 1:
            raise PlanError(
                f"{path}: {controller.name} runs one model at a time, and its textures need {' and '.join(names)}; "
                "plan a scene for each model, or play simulated controllers, which `vibrocast play --plan` reloads"
            )
        for name in names:
            yield controller.name, controller.address, models.find(name)
