"""The subcommands that look into a wire or break it: `monitor`, `replay` and `proxy`."""

import json
import sys
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

import click

from vibrocast import progress, textures
from vibrocast.device_protocol.messages import Start, Status, pack
from vibrocast.device_protocol.trace import TracedFrame, read_trace, tracer
from vibrocast.device_protocol.transports import Transport, TransportError
from vibrocast.errors import InputError
from vibrocast.files import plain
from vibrocast.harness.frame_lines import line
from vibrocast.harness.trace_summary import summarise
from vibrocast.host import devices
from vibrocast.host.cli.answers import tell, wants_json
from vibrocast.host.cli.option_types import INPUT, Number, OutputFile
from vibrocast.host.cli.options import checked_address, given_once, link_option, tell_address
from vibrocast.host.cli.sections import SectionedCommand

if TYPE_CHECKING:
    from vibrocast.simulated_device.faulty_wire import Fault

_POLL_S = 0.05
# After the last frame of a replay, answers may come for so long.
_ANSWERS_S = 0.5

See: TypeAlias = Callable[[Iterable[TracedFrame]], None]

address_argument = click.argument("address", callback=checked_address)


class Screen:
    """Prints frames, as lines or as JSON; the first one begins the time."""

    def __init__(self) -> None:
        self._as_json = wants_json()
        self._began_ns: int | None = None

    def show(self, frames: Iterable[TracedFrame]) -> None:
        """Print frames."""
        for frame in frames:
            if self._began_ns is None:
                self._began_ns = frame.time_ns
            click.echo(json.dumps(frame.as_json()) if self._as_json else plain(line(frame, self._began_ns)))
        sys.stdout.flush()


@click.command(
    cls=SectionedCommand,
    epilog="vibrocast monitor serial:/dev/ttyACM0 --link /tmp/watched\nvibrocast monitor sim --web",
)
@address_argument
@link_option
@click.option("--web", is_flag=True, help="Show signals, spectra and state on a page for your browser.")
def monitor(address: str, link: Path | None, web: bool) -> None:
    """Show the frames between a host and a controller as they pass.

    The command opens the controller at ADDRESS, and prints the address of another port on stderr. Pass that to the
    program that you want to watch as its --device. Each line has the time, the direction, the message and its fields:
    state, position, credit, buffer and the counters that are not 0.

    --json prints one JSON object a line. `vibrocast --trace FILE monitor` also writes them.

    --web prints the address of a page instead. It helps where an actuator buzzes strangely.
    """
    if not web:
        serve(address, link, (), Screen().show)
        return
    from vibrocast.harness.web_server import web_server
    from vibrocast.harness.wire_view import WireView

    view = WireView()
    with web_server(view.answer) as port:
        click.echo(f"page: http://127.0.0.1:{port}/", err=True)
        serve(address, link, (), view.note)


share_option = partial(click.option, type=Number("PART", 0, 1), default=0.0)


@click.command(
    cls=SectionedCommand,
    epilog="vibrocast proxy sim --flipped 0.02 --delay-ms 5\nvibrocast proxy serial:/dev/ttyACM0 --faults faults.toml",
)
@address_argument
@link_option
@share_option("--lost", help="Part of the frames that is lost, 0 to 1.")
@share_option("--flipped", help="Part of the frames that is damaged, 0 to 1.")
@click.option("--delay-ms", type=Number("ms", 0, 10_000), default=0.0, help="Delay of each frame.")
@click.option("--faults", "schedule", type=INPUT, metavar="FILE", help="TOML file with a schedule of faults.")
def proxy(address: str, link: Path | None, lost: float, flipped: float, delay_ms: float, schedule: Path | None) -> None:
    """Put a wire with faults between a host and a controller.

    The command opens the controller at ADDRESS, and prints the address of another port. Pass that to any program as its
    --device. The options hold for both directions and all the time. A schedule names faults with their times, and can
    pull the cable. The same faults come for the same frames.
    """
    from vibrocast.simulated_device.faulty_wire import Fault, read_faults

    faults = () if schedule is None else read_faults(schedule)
    serve(address, link, (Fault(lost=lost, flipped=flipped, delay_ms=delay_ms), *faults), None)


def serve(address: str, link: Path | None, faults: "Sequence[Fault]", see: "See | None") -> None:
    """Serve a controller behind a port of its own until Ctrl-C; raise what broke the way to it.

    `see` takes the frames as they pass.
    """
    from vibrocast.simulated_device.faulty_wire import FaultyWire, RemoteDevice
    from vibrocast.simulated_device.serial_port import has_pseudo_terminals, serial_port

    if any(fault.cut for fault in faults) and not has_pseudo_terminals():
        raise TransportError(
            "a cut cable needs pseudo-terminals, which this system lacks", action="leave out `cut`", parameter="cut"
        )
    with devices.reach(address) as transport:

        def pull(is_out: bool) -> None:
            # Not in the thread of the port, which this waits for.
            threading.Thread(target=getattr(port, "unplug" if is_out else "plug"), daemon=True).start()

        remote = RemoteDevice(transport, pull if has_pseudo_terminals() else None)
        port = serial_port(FaultyWire(remote, faults, 0, pull), link)
        try:
            with port:
                tracer.take()
                tell_address(port.name, err=see is not None)
                while remote.failure is None:
                    time.sleep(_POLL_S)
                    if see is not None:
                        see(tracer.take())
        except TransportError:  # the port says that its controller has failed
            if remote.failure is None:
                raise
        if remote.failure is not None:
            raise remote.failure


@click.command(
    cls=SectionedCommand,
    epilog="vibrocast replay oak.pcapng --summary\nvibrocast replay oak.pcapng --device sim",
)
@click.argument("trace", type=INPUT)
@click.option(
    "--decode",
    "out",
    type=OutputFile(*textures.SAVED_SUFFIXES),
    metavar="FILE",
    help="File for the last stream, decoded up to a missing packet.",
)
@click.option(
    "--device",
    "address",
    callback=given_once(checked_address),
    metavar="ADDRESS",
    multiple=True,
    help="Controller that gets the frames from the host, at their times.",
)
@click.option("--summary", is_flag=True, help="Sum up losses, silences and damage, and name the likely cause.")
def replay(trace: Path, out: Path | None, address: str | None, summary: bool) -> None:
    """Show, sum up, decode or send again the frames of a trace.

    Without an option, the command shows the frames of TRACE, a .pcapng or .jsonl file of `vibrocast --trace`. With it,
    the frames from the host go to the controller at the times of the trace, and the command shows both directions.
    """
    screen, frames = Screen(), list(read_trace(trace))
    if out is not None:
        decode_last(frames, trace, out)
        return
    if summary:
        summed = summarise(frames)
        tell("\n".join(summed.lines()), **summed.document())
        return
    if address is None:
        screen.show(frames)
        return
    with devices.reach(address) as transport:
        tracer.take()
        send_again(transport, [each for each in frames if each.from_host], first_device_us(frames), screen)


def decode_last(frames: Sequence[TracedFrame], trace: Path, out: Path) -> None:
    """Decode the last stream of a trace into a file. Raises InputError, StreamError, CodecError, OSError."""
    from vibrocast.codec.stream import write_recording
    from vibrocast.harness.trace_streams import streams_of

    streams = streams_of(frames)
    if not streams:
        raise InputError(f"{trace}: no stream was set up in it; trace the whole command")
    stream = streams[-1].stream()
    with progress.bar("decoding") as update:
        write_recording(out, stream, progress=update)
    tell(f"{out}: {stream.seconds:.3f} s at {stream.header.rate_hz} Hz", out=str(out), seconds=stream.seconds)


def first_device_us(frames: Iterable[TracedFrame]) -> int | None:
    """Return the controller's time in the first Status of a trace; None without one."""
    for frame in frames:
        found = frame.message()
        if found is not None and isinstance(found[1], Status):
            return found[1].device_time_us
    return None


def send_again(transport: Transport, frames: Sequence[TracedFrame], before_us: int | None, screen: Screen) -> None:
    """Send frames at their times. `before_us`: the controller's time then, by which that of a Start is moved."""
    from vibrocast.device_protocol.frames import DELIMITER, write_frame

    began_s = time.monotonic()
    shift_us: int | None = None
    for frame in frames:
        due_s = began_s + (frame.time_ns - frames[0].time_ns) / 1e9
        encoded = frame.encoded + DELIMITER
        while True:
            transport.read(max(0.0, min(_POLL_S, due_s - time.monotonic())))
            if shift_us is None and before_us is not None and (now_us := first_device_us(tracer.frames)) is not None:
                shift_us = now_us - before_us
            screen.show(tracer.take())
            if time.monotonic() >= due_s:
                break
        found = frame.message()
        if found is not None and isinstance(found[1], Start) and found[1].device_time_us and shift_us is not None:
            moved = Start(max(0, found[1].device_time_us + shift_us))
            encoded = write_frame(pack(moved, found[0]))
        transport.write(encoded)
    until_s = time.monotonic() + _ANSWERS_S
    while time.monotonic() < until_s:
        transport.read(_POLL_S)
    screen.show(tracer.take())
