"""`vibrocast train`: trains the learned codec from a configuration file, or a sweep of trainings on many workers."""

from collections.abc import Iterator
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

import click

from vibrocast import progress
from vibrocast.host.cli.answers import tell
from vibrocast.host.cli.option_types import FOLDER, INPUT
from vibrocast.host.cli.sections import MORE, SectionedCommand, section


@click.command(
    cls=SectionedCommand,
    epilog="vibrocast train examples/tiny.toml\nvibrocast train examples/eva.toml --data recordings --resume",
)
@click.argument("config", type=INPUT)
@click.option(
    "--data",
    "data_folder",
    type=INPUT,
    metavar="FOLDER",
    help="Folder of the data of CONFIG. Default: the folder of CONFIG.",
)
@section(
    MORE,
    click.option(
        "--split",
        type=click.Choice(("material", "trace")),
        default="material",
        help="Held back: materials of CONFIG, or traces of all recordings in --data.",
    ),
)
@click.option(
    "--out",
    type=FOLDER,
    default="trained",
    help="Folder for the checkpoints, under the training's name.",
)
@click.option("--resume", is_flag=True, help="Continue a training that was cut.")
@section(
    MORE,
    click.option(
        "--scheduler",
        metavar="ADDRESS",
        help="Dask scheduler that you trust, for a sweep. Default: this machine.",
    ),
)
def train(
    config: Path,
    data_folder: Path | None,
    split: str,
    out: Path,
    resume: bool,
    scheduler: str | None,
) -> None:
    """Train a model from a TOML configuration.

    examples/eva.toml is such a CONFIG. Export the checkpoint, OUT/NAME/checkpoint.pt, with `vibrocast export`.

    --split trace ignores the sources of CONFIG. It trains on the recordings under --data and holds back a fifth of
    them, as the EVA paper does.

    A sweep runs its trainings in parallel, each on one core. A scheduler's ADDRESS is one such as tcp://host:8786.
    Trust it: whoever runs it, or its workers, can run any program as you on this machine.
    """
    from vibrocast.export import configuration, training
    from vibrocast.textures import dataset

    chosen = configuration.read(config)
    if split == "trace":
        if data_folder is None:
            raise click.UsageError("--split trace trains on all recordings of a folder; name it by --data")
        chosen = configuration.by_trace(chosen)
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
            (outcome,) = (run(update) for run in trainings.values())
        tell(str(outcome), trainings=[str(outcome)])
        return
    run_sweep({name: partial(run, _silent, 1) for name, run in trainings.items()}, scheduler)


def run_sweep(trainings: dict[str, Any], scheduler: str | None) -> None:
    """Run trainings on all cores, or on the workers of a Dask scheduler; one that fails costs only itself."""
    from vibrocast import workers

    work: Any = partial(workers.on_cores, processes=workers.cores())
    if scheduler:
        work = partial(workers.on_cluster, address=scheduler, version=workers.program_version)
    tasks: Iterator[Any] = iter(trainings.items())
    failed = []
    ended: list[str] = []
    with progress.bar("training") as update, closing(work(tasks)) as outcomes:
        update(0, f"0 of {len(trainings)}")
        for done, (name, outcome) in enumerate(outcomes, 1):
            if isinstance(outcome, Exception):
                failed.append(name)
                click.echo(f"failed: {name}: {outcome}", err=True)
            else:
                ended.append(str(outcome))
                tell(str(outcome), trainings=ended)
            update(done / len(trainings), f"{done} of {len(trainings)}")
    if failed:
        raise click.ClickException(
            f"{len(failed)} of {len(trainings)} trainings failed: {', '.join(failed)}; correct them and add --resume"
        )


def _silent(part: float, details: str = "", /) -> None:
    """Show nothing: bars of many processes would write over each other."""
