"""The subcommands on controllers: `devices`, `flash`, `status` and `simulate`."""

import time
from pathlib import Path

import click

from vibrocast import models, progress
from vibrocast.errors import InputError
from vibrocast.files import plain
from vibrocast.host import devices, uploader
from vibrocast.host.cli.answers import add, tell, wants_json
from vibrocast.host.cli.option_types import INPUT, OutputFile
from vibrocast.host.cli.options import (
    actuator_option,
    chosen_model,
    device_option,
    link_option,
    own_actuator,
    tell_address,
)
from vibrocast.host.cli.steps import show
from vibrocast.output.actuator import ACTUATORS, PIEZO_STACK


@click.command("devices")
def list_devices() -> None:
    """List addresses: simulated, serial, USB and sound cards."""
    found = devices.available()
    add(found)
    if wants_json():
        return
    width = max(map(len, found))
    for address, description in found.items():
        click.echo(plain(f"{address:{width}}  {description}"))


@click.command()
@click.argument("model", callback=chosen_model)
@device_option
def flash(model: models.Model, address: str) -> None:
    """Upload a trained model to a controller.

    MODEL is a name that `vibrocast models` lists, a folder of `vibrocast export`, or a model image. The command
    transfers the model, reads it back, tests it on the controller and confirms it.

    After an interruption, run the same command again: it continues. Until then the controller runs the previous image.
    """
    upload(model, address)


def upload(model: models.Model, address: str, name: str = "") -> None:
    """Upload a model to the controller at an address, of this `name` in a plan; tell which image it runs then."""
    with devices.connect(address) as controller, progress.bar("uploading") as update:
        slot = uploader.flash(controller, model.image, progress=lambda done, total: update(done / total))
        checked = controller.description.public_key
    signature = f"number {slot.number}, signature checked" if checked else "no signature checked"
    facts = {"model": slot.name, "version": slot.version, "slot": slot.slot, "sha256": slot.sha256.hex()}
    told = f"{slot.name} {slot.version} runs from slot {slot.slot}, confirmed; {signature}"
    tell(f"{name}: {told}" if name else told, **({name: facts} if name else facts))


@click.command()
@device_option
@actuator_option
def status(address: str, actuator_name: str | None) -> None:
    """Show the properties and state of a controller."""
    with devices.connect(address, actuator=own_actuator(address, actuator_name)) as controller:
        facts = devices.facts(controller)
    show(facts)


@click.command()
@click.option(
    "--actuator",
    type=click.Choice(sorted(ACTUATORS)),
    default=PIEZO_STACK.name,
    show_default=True,
    help="Choose the actuator to simulate.",
)
@link_option
@click.option("--flash-file", type=OutputFile(), help="Keep model images in this file. Default: lost at the end.")
@click.option("--public-key", type=INPUT, metavar="FILE", help="Take only model images that this key signed.")
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
    settings = Settings(actuator=ACTUATORS[actuator], public_key=key)
    with serial_port(SimulatedController(settings, flash_memory), link) as port:
        tell_address(port.name)
        while True:
            time.sleep(1.0)  # on Windows, Ctrl-C interrupts no wait for an event
