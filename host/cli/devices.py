"""The subcommands on controllers: `devices`, `flash`, `status` and `simulate`."""

import sys
import time
from pathlib import Path

import click

from vibrocast import models, progress
from vibrocast.host import devices, uploader
from vibrocast.host.cli import planned
from vibrocast.host.cli.options import (
    BadInput,
    OutputFile,
    chosen_model,
    device_option,
    plan_option,
    runtime_option,
)
from vibrocast.host.cli.steps import needed, show
from vibrocast.output.actuator import ACTUATORS, PIEZO_STACK


@click.command("devices")
def list_devices() -> None:
    """List what may be a controller."""
    show(devices.available())


@click.command()
@click.argument("model", callback=chosen_model, required=False)
@plan_option
@device_option
def flash(model: models.Model | None, plan_path: Path | None, address: str) -> None:
    """Upload MODEL, or with --plan every model that the plan needs, to a controller.

    MODEL is the name of a model, its folder, or a model image. The command transfers it, reads it back, tests it
    there and confirms it. After an interruption the same command goes on where it stopped; until then the controller
    runs the previous image.
    """
    if plan_path is not None:
        for name, planned_address, needed_model in planned.needed_models(plan_path):
            click.echo(f"{name}: {flashed(needed_model, planned_address)}")
        return
    click.echo(flashed(needed(model, "MODEL"), address))


def flashed(model: models.Model, address: str) -> str:
    """Flash a model into the controller at an address; return what it runs then."""
    with devices.connect(address) as controller, progress.bar("flashing") as update:
        slot = uploader.flash(controller, model.image, progress=lambda done, total: update(done / total))
    return f"{slot.name} {slot.version} runs from slot {slot.slot}, confirmed"


@click.command()
@device_option
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def status(address: str, as_json: bool) -> None:
    """Show the properties and the state of a controller."""
    with devices.connect(address) as controller:
        facts = devices.facts(controller)
    show(facts, as_json)


@click.command()
@click.option("--actuator", type=click.Choice(sorted(ACTUATORS)), default=PIEZO_STACK.name, show_default=True)
@click.option("--drift-ppm", type=click.IntRange(-10_000, 10_000), default=0, show_default=True, help="Of its clock.")
@click.option("--flash-file", type=OutputFile(), help="Keeps the model images; without it they last until the end.")
@runtime_option
def simulate(actuator: str, drift_ppm: int, flash_file: Path | None, runtime: str | None) -> None:
    """Run a simulated controller until Ctrl-C.

    It prints the address of its serial port, which other programs open: a pseudo-terminal on Linux and macOS, a socket
    on Windows.
    """
    from vibrocast.simulated_device.controller import FLASH_BYTES, Settings
    from vibrocast.simulated_device.controller import Controller as SimulatedController
    from vibrocast.simulated_device.flash import FlashMemory
    from vibrocast.simulated_device.serial_port import serial_port

    if flash_file and flash_file.exists() and not (flash_file.is_file() and flash_file.stat().st_size == FLASH_BYTES):
        raise BadInput(f"{flash_file}: not the {FLASH_BYTES} bytes of this flash memory; give a name for a new file")
    flash_memory = FlashMemory(FLASH_BYTES, path=flash_file)
    settings = Settings(actuator=ACTUATORS[actuator], drift_ppm=drift_ppm, runtime=runtime)
    with serial_port(SimulatedController(settings, flash_memory)) as port:
        click.echo(f"serial:{port.name}")
        sys.stdout.flush()
        while True:
            time.sleep(1.0)  # on Windows, Ctrl-C interrupts no wait for an event
