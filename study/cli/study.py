"""The subcommand `study`: checks, runs, simulates and reports listening studies."""

import contextlib
from collections.abc import Iterator
from pathlib import Path

import click

from vibrocast import extras, progress
from vibrocast.errors import InputError
from vibrocast.files import atomic_write
from vibrocast.host import devices
from vibrocast.host.cli.answers import tell
from vibrocast.host.cli.option_types import FOLDER, INPUT, Whole
from vibrocast.host.cli.options import device_option
from vibrocast.host.cli.sections import MORE, SectionedCommand, section
from vibrocast.output import actuator_files
from vibrocast.output.actuator import Actuator
from vibrocast.study import stimuli as stimuli_module
from vibrocast.study.analysis import STIMULI, STUDY_FILE
from vibrocast.study.study_file import Study, read_study
from vibrocast.study.trials import Stimulus, StimulusPlayer

study_argument = click.argument("study_path", metavar="STUDY", type=INPUT)
out_option = click.option("--out", type=FOLDER, required=True, help="Folder for stimuli and results.")


@click.group()
def study() -> None:
    """Check, run, simulate and report listening studies.

    A TOML file describes the study. Each participant's answers are on disk before the next trial.
    """


@study.command(
    cls=SectionedCommand,
    epilog="vibrocast study check examples/studies/touch.toml\n"
    "vibrocast study check examples/studies/touch.toml --device audio:default",
)
@study_argument
@device_option
def check(study_path: Path, address: str) -> None:
    """Prepare all stimuli, and reject sets that cannot be compared.

    Levels are matched at the skin. Limits of the actuator must act on all conditions of a texture alike.
    """
    read = read_study(study_path)
    actuator = driven(address, chosen_actuator(read))
    prepared = prepare(read, actuator)
    click.echo(f"{'stimulus':42} {'level dB':>9} {'gain dB':>8} {'limited %':>9} {'SNR dB':>7}")
    for each in prepared:
        facts = each.facts
        ratio = "" if facts["snr_db"] is None else f"{facts['snr_db']:.1f}"
        click.echo(
            f"{each.key:42} {facts['level_db'] or 0.0:9.1f} {each.gain_db:8.1f} {100 * (facts['limited'] or 0):9.2f} "
            f"{ratio:>7}"
        )
    reject_problems(read, actuator, prepared)
    tell(f"{len(prepared)} stimuli can be compared on {actuator.name}")


@study.command(
    cls=SectionedCommand,
    epilog="vibrocast study run examples/studies/touch.toml --participant 1 --out answers\n"
    "vibrocast study run examples/studies/touch.toml --participant 2 --out answers --terminal",
)
@study_argument
@click.option(
    "--participant", type=Whole("NUMBER", 1, 9999), required=True, help="Number of the participant; give no names."
)
@click.option("--terminal", is_flag=True, help="Ask in the terminal. Default: in a browser.")
@section(
    MORE,
    click.option("--host", default="127.0.0.1", help="Address of the pages."),
    click.option("--port", type=Whole("PORT", 0, 65_535), default=8017, help="Port of the pages."),
)
@device_option
@out_option
def run(
    study_path: Path,
    participant: int,
    terminal: bool,
    host: str,
    port: int,
    address: str,
    out: Path,
) -> None:
    """Lead a participant through a study, in a browser or terminal.

    The command prepares the stimuli at the first run and keeps them in the folder. If it is interrupted, run it again:
    it goes on after the last answer.
    """
    from vibrocast.study.session import Session
    from vibrocast.study.terminal import run_in_terminal

    read = read_study(study_path)
    actuator = chosen_actuator(read)
    prepared = prepared_once(read, driven(address, actuator), study_path, out)
    with open_player(address, actuator, prepared, read) as player:
        session = Session(read, prepared, participant, participant_folder(out, participant), player, address)
        try:
            for warning in session.state().warnings:
                click.echo(f"warning: {warning}", err=True)
            if terminal:
                run_in_terminal(session, lambda prompt: click.prompt(prompt, default="", prompt_suffix="",
                                show_default=False), click.echo)  # fmt: skip
            else:
                from vibrocast.study.server import Aids, serve

                noise, hand = read.masking_noise, read.hand
                aids = Aids(
                    stimulus_seconds=read.stimulus_seconds,
                    masking_noise_dbfs=None if noise is None else noise.level_db,
                    masking_noise_spectrum="white" if noise is None else noise.spectrum,
                    strokes_per_minute=None if hand is None else 60 / hand.stroke_s,
                )
                serve(session, host, port, aids, click.echo)
        finally:
            session.close()


@study.command(
    cls=SectionedCommand,
    epilog="vibrocast study simulate examples/studies/touch.toml --out simulated\n"
    "vibrocast study simulate examples/studies/touch.toml --participants 40 --out simulated",
)
@study_argument
@click.option(
    "--participants",
    type=Whole("NUMBER", 1, 1000),
    default=10,
    help="Number of simulated participants.",
)
@out_option
def simulate(study_path: Path, participants: int, out: Path) -> None:
    """Let simulated observers take part, to test and plan a study.

    A simulated observer is no person: use it to find mistakes in a study, not to answer its question.
    """
    from vibrocast.study.observer import ObserverSettings
    from vibrocast.study.simulation import SkinOf, simulate_participant

    read = read_study(study_path)
    actuator = chosen_actuator(read)
    prepared = prepared_once(read, actuator, study_path, out)
    skin_of, settings = SkinOf(prepared, actuator), ObserverSettings()
    with progress.bar("simulating") as update:
        for number in range(1, participants + 1):
            simulate_participant(read, prepared, skin_of, number, participant_folder(out, number), settings)
            update(number / participants)
    tell(
        f"{participants} simulated observers answered; `vibrocast study report {out}` analyses them",
        participants=participants,
        out=str(out),
    )


@study.command(
    cls=SectionedCommand,
    epilog="vibrocast study report answers\nvibrocast study report answers --json",
)
@click.argument("folder", type=INPUT)
def report(folder: Path) -> None:
    """Analyse the answers of a study: tables, charts and one page.

    The command writes them into FOLDER/report.
    """
    extras.require("study")
    from vibrocast.study.report import write_report

    page = str(write_report(folder, folder / "report"))
    tell(page, page=page)


def chosen_actuator(read: Study) -> Actuator:
    """Return the actuator that the study file names. Raises InputError where it names none."""
    if read.actuator is None:
        raise InputError(f"{read.name}: no actuator; name one by the key actuator of the study file")
    path = Path(read.folder) / read.actuator
    return actuator_files.find(path if path.is_file() else read.actuator)


def driven(address: str, actuator: Actuator) -> Actuator:
    """Return the actuator as the device at an address drives it: a sound card has another DAC, and its own volts."""
    return devices.sound_card_of(address, actuator)[2] if devices.is_sound_card(address) else actuator


def prepare(read: Study, actuator: Actuator) -> tuple[Stimulus, ...]:
    """Prepare the stimuli of a study, with a progress bar."""
    with progress.bar("preparing") as update:
        return stimuli_module.prepare(read, actuator, update)


def prepared_once(read: Study, actuator: Actuator, study_path: Path, out: Path) -> tuple[Stimulus, ...]:
    """Return the stimuli in a results folder, which are prepared and checked if they are not there yet."""
    folder, kept = out / STIMULI, out / STUDY_FILE
    if (folder / stimuli_module.STIMULI).exists() and kept.exists():
        if kept.read_bytes() != study_path.read_bytes():
            raise InputError(f"{out}: results of another study file; give another folder, or {kept}")
        return stimuli_module.load(folder, actuator)
    prepared = prepare(read, actuator)
    reject_problems(read, actuator, prepared)
    stimuli_module.save(folder, prepared, actuator)
    with atomic_write(kept) as partial:
        partial.write_bytes(study_path.read_bytes())
    return prepared


def reject_problems(read: Study, actuator: Actuator, prepared: tuple[Stimulus, ...]) -> None:
    """Raise InputError if stimuli cannot be compared."""
    if problems := stimuli_module.problems(read, actuator, prepared):
        raise InputError("; ".join(f"{each.texture}: {each.text}" for each in problems))


def participant_folder(out: Path, participant: int) -> Path:
    """Return the folder of one participant's results."""
    return out / f"participant_{participant:03}"


@contextlib.contextmanager
def open_player(
    address: str, actuator: Actuator, prepared: tuple[Stimulus, ...], read: Study
) -> Iterator[StimulusPlayer]:
    """Open a device for a study, and prepare it for all stimuli. Raises ControllerError, TransportError, InputError."""
    from vibrocast.study.device_player import CardPlayer, ControllerPlayer, HandPlayer

    hand = read.hand if read.hand is not None and read.hand.plays else None
    if hand is not None and devices.is_sound_card(address):
        raise InputError(f"{address} knows no position of the hand; give a controller, or drop plays from [hand]")
    if devices.is_sound_card(address):
        player = CardPlayer(*devices.sound_card_of(address, actuator))
        try:
            player.prepare(prepared)
            yield player
        finally:
            player.close()
        return
    with devices.open_session(address, actuator=actuator) as opened:
        on_controller = ControllerPlayer(opened) if hand is None else HandPlayer(opened, hand, read.stimulus_seconds)
        on_controller.prepare(prepared)
        yield on_controller
