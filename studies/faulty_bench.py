"""A bench in this process: the simulated controller, its actuator and a laser, each with faults."""

import contextlib
import io
import secrets
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from multiprocessing.connection import Connection, Listener
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vibrocast.device_protocol.frames import FrameReader, write_frame
from vibrocast.device_protocol.messages import Configure, Message, MessageError, SinglePacket, StreamData, pack, unpack
from vibrocast.output.actuator import LRA, PIEZO_STACK, Actuator, Codes
from vibrocast.simulated_device.controller import Controller, Settings
from vibrocast.simulated_device.device import Device
from vibrocast.simulated_device.faulty_wire import Fault, FaultyWire
from vibrocast.simulated_device.serial_port import serial_port

Displacement = NDArray[np.float64]
OVERSAMPLING = 4
NOISE_UM = 0.02
"""Standard deviation of the noise of a good laser."""
_SAME_RUN_S = 0.2
# The program of the bench file that plays the part of a laser's: it asks this process.
_SENSOR = (
    "import sys; from multiprocessing.connection import Client; port, key, file, seconds = sys.argv[1:]; "
    "laser = Client(('127.0.0.1', int(port)), authkey=bytes.fromhex(key)); laser.send(float(seconds)); "
    "open(file, 'wb').write(laser.recv_bytes())"
)


class Inner(Device):
    """A controller that a fault stands in front of; as it is, it does nothing to it."""

    def __init__(self, make: Callable[[], Controller]) -> None:
        self.make = make
        self.controller = make()

    def receive(self, data: bytes, now_us: int) -> None:
        """Take bytes from the host."""
        self.controller.receive(data, now_us)

    def advance(self, now_us: int) -> None:
        """Let time pass."""
        self.controller.advance(now_us)

    def transmit(self) -> bytes:
        """Return the bytes to send to the host."""
        return self.controller.transmit()


class Hanging(Inner):
    """Does nothing for 0.3 s of every second."""

    _late = b""

    def receive(self, data: bytes, now_us: int) -> None:
        """Take bytes, which wait while the controller hangs."""
        self._late += data
        self.advance(now_us)

    def advance(self, now_us: int) -> None:
        """Let time pass, unless the controller hangs."""
        if now_us % 1_000_000 >= 300_000:
            data, self._late = self._late, b""
            self.controller.receive(data, now_us)


class Restarting(Inner):
    """Loses its power 3 s after the host's first bytes, once."""

    _at_us: int | None = None

    def receive(self, data: bytes, now_us: int) -> None:
        """Take bytes; the first ones begin the time."""
        self._at_us = now_us + 3_000_000 if self._at_us is None else self._at_us
        super().receive(data, now_us)

    def advance(self, now_us: int) -> None:
        """Let time pass; begin again when it is over."""
        if self._at_us is not None and now_us >= self._at_us:
            self._at_us = sys.maxsize
            self.controller = self.make()
        super().advance(now_us)


class Misreading(Inner):
    """Takes each message for another one."""

    def __init__(self, make: Callable[[], Controller], misread: Callable[[Message], Message]) -> None:
        super().__init__(make)
        self._reader, self._misread = FrameReader(), misread

    def receive(self, data: bytes, now_us: int) -> None:
        """Take bytes from the host."""
        frames = b""
        for payload in self._reader.feed(data):
            with contextlib.suppress(MessageError):
                sequence, message = unpack(payload)
                frames += write_frame(pack(self._misread(message), sequence))
        super().receive(frames, now_us)


def without_compensation(message: Message) -> Message:
    """Return a Configure without compensation; any other message as it is."""
    return replace(message, compensation=False) if isinstance(message, Configure) else message


def at_half_gain(message: Message) -> Message:
    """Return a Configure with half its gain; any other message as it is."""
    return replace(message, gain=message.gain / 2) if isinstance(message, Configure) else message


def bad_memory(message: Message) -> Message:
    """Return stream data in which a bit of each long packet has flipped; any other message as it is."""
    match message:
        case StreamData():
            return replace(message, packets=tuple(map(_flipped, message.packets)))
        case SinglePacket():
            return replace(message, packet=_flipped(message.packet))
        case _:
            return message


def _flipped(packet: bytes) -> bytes:
    return packet[:-1] + bytes([packet[-1] ^ 1]) if len(packet) > 12 else packet


def unchanged(skin_um: Displacement) -> Displacement:
    """Return a displacement as it is."""
    return skin_um


@dataclass(frozen=True)
class Injected:
    """A fault of a bench, at its `place`.

    `wire`: on the way to the controller. `settings`: of the controller; `device`: in front of it. `stopped_s`: the host
    is stopped so long at a time, again and again after `running_s`. `actuator`: the one that moves the skin. `moved`:
    how the displacement of the skin, um, differs from that. `recorded`: what the laser makes of it; None = nothing.
    """

    place: str
    fault: str
    wire: tuple[Fault, ...] = ()
    settings: Mapping[str, Any] = field(default_factory=dict)
    device: Callable[[Callable[[], Controller]], Inner] = Inner
    stopped_s: float = 0.0
    running_s: float = 1.0
    actuator: Actuator = PIEZO_STACK
    moved: Callable[[Displacement], Displacement] = unchanged
    recorded: Callable[[Displacement], Displacement] | None = unchanged


def _rms(values: Displacement) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _noise_only(skin_um: Displacement) -> Displacement:
    return _rms(skin_um) * np.random.default_rng(2).standard_normal(skin_um.shape)


def _five_percent_fast(skin_um: Displacement) -> Displacement:
    places = np.arange(0, len(skin_um) - 1, 1.05)
    return np.asarray(np.interp(places, np.arange(len(skin_um)), skin_um[:, 0]))[:, None]


FAULTS = (
    Injected("wire", "4 % of the frames are lost", wire=(Fault(lost=0.04),)),
    Injected("wire", "2 % of the frames there are damaged", wire=(Fault(flipped=0.02, direction="to_controller"),)),
    Injected("wire", "2 % of the frames back are damaged", wire=(Fault(flipped=0.02, direction="to_host"),)),
    Injected("wire", "5 % of the frames come twice", wire=(Fault(doubled=0.05),)),
    Injected("wire", "2 % of the frames come out of order", wire=(Fault(swapped=0.02),)),
    Injected("wire", "a delay of 30 ms", wire=(Fault(delay_ms=30.0),)),
    Injected("wire", "a jitter of 60 ms", wire=(Fault(jitter_ms=60.0),)),
    Injected("wire", "a capacity of 20 kbit/s", wire=(Fault(bits_per_second=20_000.0),)),
    Injected("wire", "the cable is out for 4 s", wire=(Fault(at_s=3.0, for_s=4.0, cut=True),)),
    Injected("host", "stops for 0.3 s every second", stopped_s=0.3),
    Injected("host", "stops for 3 s, again and again", stopped_s=3.0, running_s=3.0),
    Injected("host", "runs at a fifth of its speed", stopped_s=0.04, running_s=0.01),
    Injected("device", "the clock runs 1000 ppm fast", settings={"drift_ppm": 1000}),
    Injected("device", "drives another actuator", settings={"actuator": LRA}),
    Injected("device", "is another board", settings={"serial_number": "2"}),
    Injected("device", "leaves out the compensation", device=partial(Misreading, misread=without_compensation)),
    Injected("device", "plays at half the gain", device=partial(Misreading, misread=at_half_gain)),
    Injected("device", "has bad memory", device=partial(Misreading, misread=bad_memory)),
    Injected("device", "hangs for 0.3 s every second", device=Hanging),
    Injected("device", "restarts while it plays", device=Restarting),
    Injected("actuator", "is not connected", moved=np.zeros_like),
    Injected("actuator", "has lost 40 % of its bandwidth", actuator=replace(PIEZO_STACK, corner_hz=162.0)),
    Injected("actuator", "moves half as far", moved=lambda skin_um: skin_um / 2),
    Injected("actuator", "is connected the wrong way round", moved=np.negative),
    Injected("actuator", "hits a stop", moved=lambda skin_um: np.clip(skin_um, -1.0, 1.0)),
    Injected("sensor", "records noise of the same level", recorded=_noise_only),
    Injected("sensor", "states a tenth of its sensitivity", recorded=lambda skin_um: 10 * skin_um),
    Injected("sensor", "samples 5 % too slowly", recorded=_five_percent_fast),
    Injected("sensor", "records silence", recorded=np.zeros_like),
    Injected("sensor", "records nothing", recorded=None),
)
SOUND = Injected("none", "none")


class _Skin:
    """The DAC codes of a controller over time, and the displacement that they make."""

    def __init__(self, injected: Injected) -> None:
        self._injected = injected
        self._rate_hz = injected.actuator.dac_rate_hz
        self._runs: list[tuple[int, Codes]] = []
        self._lock = threading.Lock()

    def note(self, codes: Codes) -> None:
        """Take codes that go to the DAC by now."""
        now = round(time.monotonic() * self._rate_hz)
        with self._lock:
            end = self._runs[-1][0] + len(self._runs[-1][1]) if self._runs else 0
            begins = end if abs(now - len(codes) - end) < _SAME_RUN_S * self._rate_hz else now - len(codes)
            self._runs.append((begins, codes[:, :1]))

    def displacement_um(self, from_s: float, seconds: float) -> Displacement:
        """Return what moved the skin from a monotonic time on, (n, 1) at OVERSAMPLING times the DAC's rate."""
        first, count = round(from_s * self._rate_hz), round(seconds * self._rate_hz)
        codes = np.zeros((count, 1), np.int16)
        with self._lock:
            for begins, run in self._runs:
                start = begins - first
                if start < count and start + len(run) > 0:
                    codes[max(0, start) : start + len(run)] = run[max(0, -start) : count - start]
        return self._injected.moved(self._injected.actuator.displacement_um(codes, OVERSAMPLING))


class _Laser:
    """Answers the sensor's program of the bench file, one recording at a time."""

    def __init__(self, injected: Injected, skin: _Skin) -> None:
        self._recorded, self._skin = injected.recorded, skin
        key = secrets.token_bytes()
        self._listener = Listener(("127.0.0.1", 0), authkey=key)
        _, port = self._listener.address
        self.command = [sys.executable, "-c", _SENSOR, str(port), key.hex(), "{file}", "{seconds}"]
        threading.Thread(target=self._serve, daemon=True).start()

    def _serve(self) -> None:
        with contextlib.suppress(OSError):  # the listener has been closed
            while True:
                with self._listener.accept() as asked, contextlib.suppress(EOFError, BrokenPipeError):
                    self._record(asked)

    def _record(self, asked: "Connection[Any, Any]") -> None:
        seconds, from_s = float(asked.recv()), time.monotonic()
        time.sleep(seconds + _SAME_RUN_S)
        if self._recorded is not None:
            seen = self._recorded(self._skin.displacement_um(from_s, seconds))
            seen = seen + NOISE_UM * np.random.default_rng(1).standard_normal(seen.shape)
            file = io.BytesIO()
            np.save(file, seen)
            asked.send_bytes(file.getvalue())

    def close(self) -> None:
        """Answer no more."""
        self._listener.close()


@contextlib.contextmanager
def faulty_bench(injected: Injected, folder: Path, limits: str) -> Iterator[Path]:
    """Run a bench with a fault; yield its bench file, in `folder`. `limits`: lines of its [limits]."""
    skin = _Skin(injected)
    settings = Settings(**{"serial_number": "1", **injected.settings})
    device: Device = injected.device(partial(Controller, settings, None, skin.note))

    def pull(is_out: bool) -> None:
        # Not in the thread of the port, which this waits for.
        threading.Thread(target=getattr(port, "unplug" if is_out else "plug"), daemon=True).start()

    if injected.wire:
        device = FaultyWire(device, injected.wire, on_cut=pull)
    port = serial_port(device)
    with port, contextlib.closing(_Laser(injected, skin)) as laser:
        path = folder / "bench.toml"
        path.write_text(
            f'[[controllers]]\nname = "it"\naddress = "serial:{port.name}"\n'
            '[[actuators]]\nmodel = "piezo-stack"\n'
            f'[[sensors]]\nname = "laser"\nkind = "laser"\nsuffix = ".npy"\nunit = "um"\n'
            f"rate_hz = {OVERSAMPLING * PIEZO_STACK.dac_rate_hz}\ncommand = {laser.command}\n"
            f'[[textures]]\ngenerate = "rough"\nseconds = 2.0\n[limits]\n{limits}',
            encoding="utf-8",
        )
        yield path


def run_host(injected: Injected, command: Sequence[str], within_s: float = 600.0) -> tuple[int, str]:
    """Run the host's program on a bench with a fault; return its exit code, and what it printed on stderr."""
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) as process:
        ended = threading.Event()
        if injected.stopped_s:
            threading.Thread(target=_stop_again_and_again, args=(process, injected, ended), daemon=True).start()
        try:
            _, said = process.communicate(timeout=within_s)
        except subprocess.TimeoutExpired:
            process.kill()
            raise
        finally:
            ended.set()
    return process.returncode, said


def _stop_again_and_again(process: "subprocess.Popen[str]", injected: Injected, ended: threading.Event) -> None:
    while not ended.wait(injected.running_s):
        process.send_signal(signal.SIGSTOP)
        ended.wait(injected.stopped_s)
        process.send_signal(signal.SIGCONT)
