"""The subcommands on controllers: `devices`, `flash`, `status` and `simulate`."""

import copy
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import click

from vibrocast import models, progress
from vibrocast.device_protocol.messages import ImageDescription, SlotState
from vibrocast.errors import InputError
from vibrocast.files import atomic_write, plain
from vibrocast.host import devices, uploader
from vibrocast.host.bench_file import BenchController
from vibrocast.host.cli.answers import add, tell, wants_json
from vibrocast.host.cli.errors import controllers_failed
from vibrocast.host.cli.option_types import INPUT, OutputFile
from vibrocast.host.cli.options import (
    actuator_option,
    chosen_image,
    device_option,
    devices_option,
    link_option,
    own_actuator,
    tell_address,
)
from vibrocast.host.cli.sections import MORE, SectionedCommand, section
from vibrocast.host.cli.steps import lines_of, show
from vibrocast.host.controller import Controller, ControllerError
from vibrocast.output import actuator_files
from vibrocast.output.actuator import PIEZO_STACK


@click.command(
    "devices",
    cls=SectionedCommand,
    epilog="vibrocast devices\nvibrocast devices --json",
)
def list_devices() -> None:
    """List addresses: simulated, serial, USB and sound cards."""
    found = devices.available()
    add(found)
    if wants_json():
        return
    width = max(map(len, found))
    for address, description in found.items():
        click.echo(plain(f"{address:{width}}  {description}"))


@click.command(
    "upload",
    cls=SectionedCommand,
    epilog="vibrocast upload mdct-textures\nvibrocast upload actuator.toml --device serial:/dev/ttyACM0",
)
@click.argument("model", required=False, callback=chosen_image)
@devices_option
@click.option("--list", "lists", is_flag=True, help="List the slots and the models in them.")
@click.option("--rollback", is_flag=True, help="Run the verified model of the other slot again.")
@click.option("--erase", "erases", is_flag=True, help="Empty the slots that are not in use.")
@section(
    MORE,
    click.option("--read-back", type=OutputFile(), help="File for the model that the controller runs."),
    click.option(
        "--verify", "verifies", is_flag=True, help="Compare MODEL with the slot that holds it; write nothing."
    ),
    click.option("--no-confirm", "no_confirm", is_flag=True, help="Leave the model on trial until the next restart."),
)
def upload_model(
    model: models.Model | None,
    chosen: tuple[BenchController, ...],
    lists: bool,
    rollback: bool,
    erases: bool,
    read_back: Path | None,
    verifies: bool,
    no_confirm: bool,
) -> None:
    """Upload a trained model to controllers.

    MODEL is a name that `vibrocast models` lists, a folder of `vibrocast export`, or a model image. It may also be an
    actuator's TOML file: the controller then drives this one, within the limits of its firmware. The command
    transfers the model, reads it back, tests it on the controller and confirms it. A model that the board cannot use is
    rejected before anything is written.

    With several --device, all are served at once, and each gets a line.

    After an interruption, run the same command again: it continues. Until then the controller runs the previous image.
    """
    choices: tuple[tuple[bool, Work], ...] = ((lists, list_slots), (rollback, roll_back), (erases, erase))
    asked = [work for is_asked, work in choices if is_asked]
    if read_back is not None:
        asked.append(partial(write_back, read_back))
    if model is not None:
        asked.append(partial(verify, model) if verifies else partial(flash, model, not no_confirm))
    if len(asked) != 1:
        raise click.UsageError("give a MODEL, --list, --rollback, --erase or --read-back, and one of them")
    if verifies + no_confirm > (model is not None):
        raise click.UsageError("--verify or --no-confirm goes with a MODEL; give one of the two with it")
    if read_back is not None and len(chosen) > 1:
        raise click.UsageError("--read-back writes one file; give one --device")
    on_all(asked[0], [each.address for each in chosen])


flash_model = copy.copy(upload_model)
"""The same by its other name."""
flash_model.name = "flash"

Work = Callable[[Controller, Callable[[int, int], None]], tuple[str, dict[str, object]]]
"""What is done with a controller: it returns a line for a person, and facts for a program."""


def on_one(work: Work, address: str) -> tuple[str, dict[str, object]]:
    """Do the work with the controller at an address."""
    with devices.connect(address) as controller, progress.bar("transferring") as update:
        return work(controller, lambda done, total: update(done / total))


def on_all(work: Work, addresses: Sequence[str]) -> None:
    """Do the work with all controllers at once, and print a line for each. Raises CommandError if one fails."""
    if len(addresses) == 1:
        line, facts = on_one(work, addresses[0])
        tell(line, **facts)
        return
    names = devices.unique_names(addresses)
    with ThreadPoolExecutor(len(names)) as pool:
        running = [pool.submit(on_one, work, address) for address in addresses]
    done: dict[str, tuple[str, dict[str, object]] | Exception] = {}
    for name, each in zip(names, running, strict=True):
        error = each.exception()
        done[name] = error if isinstance(error, Exception) else each.result()
    lines, failed = lines_of(done, lambda line_and_facts: line_and_facts[0])
    add({name: {"error": str(each)} if isinstance(each, Exception) else each[1] for name, each in done.items()})
    if not wants_json():
        show({name: line.splitlines() for name, line in lines.items()}, as_words=False)
    if failed:
        raise controllers_failed(failed, len(names))


def list_slots(controller: Controller, tell_part: Callable[[int, int], None]) -> tuple[str, dict[str, object]]:
    """Return what the slots hold."""
    lines = controller.description.image_lines or ["no model image in any slot"]
    return "\n".join(lines), {"slots": devices.slots(controller.description)}


def roll_back(controller: Controller, tell_part: Callable[[int, int], None]) -> tuple[str, dict[str, object]]:
    """Run the other slot's model again."""
    return about(controller, uploader.roll_back(controller))


def erase(controller: Controller, tell_part: Callable[[int, int], None]) -> tuple[str, dict[str, object]]:
    """Empty the slots that are not in use."""
    erased = uploader.erase(controller)
    return f"slots erased: {', '.join(map(str, erased)) or 'none'}", {"erased": erased}


def write_back(
    path: Path, controller: Controller, tell_part: Callable[[int, int], None]
) -> tuple[str, dict[str, object]]:
    """Write the image that the controller runs to a file."""
    held = uploader.running(controller)
    if held is None:
        raise ControllerError("the controller runs no model image; upload one")
    image = uploader.read_back(controller, held, tell_part)
    with atomic_write(path) as partial_path:
        partial_path.write_bytes(image)
    line, facts = about(controller, held)
    return f"{path}: {len(image)} bytes; {line}", {"path": str(path), "bytes": len(image), **facts}


def verify(
    model: models.Model, controller: Controller, tell_part: Callable[[int, int], None]
) -> tuple[str, dict[str, object]]:
    """Compare a model with the slot that holds it."""
    held = uploader.check_held(controller, model.image, tell_part)
    line = f"slot {held.slot} holds {model.name}, {held.state.name.lower()}: {len(model.image)} bytes are equal"
    return line, {"model": held.name, "slot": held.slot, "state": held.state.name.lower(), "bytes": len(model.image)}


def flash(
    model: models.Model, confirm: bool, controller: Controller, tell_part: Callable[[int, int], None]
) -> tuple[str, dict[str, object]]:
    """Upload a model; tell first which board gets it."""
    hello, actuator = controller.description, controller.description.actuator
    board = f"{hello.hardware}, {hello.build}, with the actuator {actuator.name}"
    click.echo(plain(f"uploading {model.name} to {board}"), err=True)
    return about(controller, uploader.flash(controller, model.image, progress=tell_part, confirm=confirm))


def about(controller: Controller, slot: ImageDescription) -> tuple[str, dict[str, object]]:
    """Return which model a controller runs now."""
    checked = controller.description.public_key
    signature = f"number {slot.number}, signature checked" if checked else "no signature checked"
    facts = {"model": slot.name, "version": slot.version, "slot": slot.slot, "sha256": slot.sha256.hex()}
    state = "confirmed" if slot.state == SlotState.CONFIRMED else "on trial until the next restart"
    return f"{slot.name} {slot.version} runs from slot {slot.slot}, {state}; {signature}", facts


def upload(model: models.Model, address: str, name: str) -> None:
    """Upload a model to the controller at an address, of this `name` in a plan; tell which image it runs then."""
    line, facts = on_one(partial(flash, model, True), address)
    tell(f"{name}: {line}", **{name: facts})


@click.command(
    cls=SectionedCommand,
    epilog="vibrocast status\nvibrocast status --device serial:/dev/ttyACM0",
)
@device_option
@actuator_option
def status(address: str, actuator_name: str | None) -> None:
    """Show the properties and state of a controller."""
    with devices.connect(address, actuator=own_actuator(address, actuator_name)) as controller:
        show(devices.facts(controller))


@click.command(
    cls=SectionedCommand,
    epilog="vibrocast simulate\nvibrocast simulate --actuator lra --flash-file flash.bin",
)
@click.option("--actuator", metavar="NAME|FILE", default=PIEZO_STACK.name, help="Actuator that is compiled in.")
@link_option
@click.option("--flash-file", type=OutputFile(), help="File that keeps model images. Default: lost at the end.")
@section(
    MORE,
    click.option(
        "--public-key",
        type=INPUT,
        metavar="FILE",
        help="Public key; only model images that its owner signed are accepted.",
    ),
)
def simulate(actuator: str, link: Path | None, flash_file: Path | None, public_key: Path | None) -> None:
    """Run a simulated controller until Ctrl-C.

    The command prints the address of its serial port. Pass it to another program as --device. The port is a
    pseudo-terminal on Linux and macOS, and a socket on Windows.
    """
    from vibrocast.firmware.keys import read_public_key
    from vibrocast.simulated_device.controller import FLASH_BYTES, Settings
    from vibrocast.simulated_device.controller import Controller as SimulatedController
    from vibrocast.simulated_device.flash import FlashMemory
    from vibrocast.simulated_device.serial_port import serial_port

    if flash_file and flash_file.exists() and not (flash_file.is_file() and flash_file.stat().st_size == FLASH_BYTES):
        raise InputError(f"{flash_file}: no flash memory, which has {FLASH_BYTES} bytes; name a new file")
    flash_memory = FlashMemory(FLASH_BYTES, path=flash_file)
    key = None if public_key is None else read_public_key(public_key)
    settings = Settings(actuator=actuator_files.find(actuator), public_key=key)
    with serial_port(SimulatedController(settings, flash_memory), link) as port:
        tell_address(port.name)
        while True:
            time.sleep(1.0)  # on Windows, Ctrl-C interrupts no wait for an event
