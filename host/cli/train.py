"""`vibrocast train`: trains the learned codec from a configuration file, or a sweep of trainings on many workers."""

from collections.abc import Iterator
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

import click

from vibrocast import extras, progress
from vibrocast.host.cli.options import INPUT, BadInput


@click.command()
@click.argument("config", type=INPUT)
@click.option(
    "--data", "data_folder", type=INPUT, help="Folder at which the paths of CONFIG start. Default: that of CONFIG."
)
@click.option(
    "--out",
    type=click.Path(file_okay=False, path_type=Path),
    default="trained",
    show_default=True,
    help="Folder that gets a folder of checkpoints for each training, by its name.",
)
@click.option("--resume", is_flag=True, help="Go on where a training was cut.")
@click.option("--threads", type=click.IntRange(min=1), help="Threads of a single training; all cores if not given.")
@click.option(
    "--scheduler", metavar="ADDRESS", help="Dask scheduler whose workers run a sweep, such as tcp://host:8786."
)
def train(
    config: Path, data_folder: Path | None, out: Path, resume: bool, threads: int | None, scheduler: str | None
) -> None:
    """Train a model as CONFIG describes it.

    examples/eva.toml is a CONFIG. OUT/NAME/checkpoint.pt is the checkpoint to export. A sweep runs its trainings side
    by side, each on one core.
    """
    extras.require("train")
    from vibrocast.export import configuration, training
    from vibrocast.export.checkpoint import ModelError
    from vibrocast.textures import dataset

    try:
        chosen = configuration.read(config)
        data = (data_folder or config.parent).resolve()
        for source in chosen.folder:
            for remark in dataset.read(data / source.folder).remarks:
                click.echo(f"{source.name}: {remark}", err=True)
        trainings = {
            one.name: partial(training.train, one, data, out.resolve() / one.name, resume)
            for one in configuration.each_of(chosen)
        }
        if len(trainings) == 1 and not scheduler:
            with progress.bar("training") as update:
                (outcome,) = (run(update, threads) for run in trainings.values())
            click.echo(outcome)
            return
    except (configuration.ConfigurationError, dataset.DatasetError, ModelError) as error:
        raise BadInput(str(error)) from error
    except training.TrainingError as error:
        raise click.ClickException(str(error)) from error
    run_sweep({name: partial(run, _silent, 1) for name, run in trainings.items()}, scheduler)


def run_sweep(trainings: dict[str, Any], scheduler: str | None) -> None:
    """Run trainings on all cores, or on the workers of a Dask scheduler; one that fails costs only itself."""
    from vibrocast.evaluation import cells, workers

    work: Any = partial(workers.on_cores, processes=workers.cores())
    if scheduler:
        work = partial(workers.on_cluster, address=scheduler, version=cells.program_version)
    tasks: Iterator[Any] = iter(trainings.items())
    failed = []
    try:
        with progress.bar("training") as update, closing(work(tasks)) as outcomes:
            update(0, f"0 of {len(trainings)}")
            for done, (name, outcome) in enumerate(outcomes, 1):
                if isinstance(outcome, Exception):
                    failed.append(name)
                    click.echo(f"failed: {name}: {outcome}", err=True)
                else:
                    click.echo(outcome)
                update(done / len(trainings), f"{done} of {len(trainings)}")
    except workers.WorkersError as error:
        raise click.ClickException(str(error)) from error
    if failed:
        raise click.ClickException(
            f"{len(failed)} of {len(trainings)} trainings failed; the same command with --resume tries them again"
        )


def _silent(part: float, details: str = "", /) -> None:
    """Show nothing: bars of many processes would write over each other."""
