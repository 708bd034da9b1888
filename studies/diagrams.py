"""Draws the pictures of the pages, as SVG in docs/figures: `python -m studies.diagrams`."""

import re
from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path

import click
import schemdraw
from schemdraw import dsp, flow
from schemdraw import elements as elm
from schemdraw.backends import svg
from schemdraw.segments import SegmentText
from schemdraw.types import Halign

import vibrocast
from studies import page
from studies.latency import Row
from tests.test_architecture import CORE, PRODUCTS
from vibrocast.device_protocol import frames, messages
from vibrocast.device_protocol.layout import wire_fields
from vibrocast.device_protocol.messages import SlotState, State
from vibrocast.evaluation.points import read_rows
from vibrocast.files import atomic_write
from vibrocast.output.actuator import PIEZO_STACK

ROOT = Path(__file__).resolve().parents[1]
RECORDING = ROOT / "examples" / "oak.wav"
BOARD = ROOT / "firmware" / "ports" / "stm32f405" / "board.h"
FIGURES = ROOT / "docs" / "figures"
DELAYS = ROOT / "docs" / "benchmarks" / "results" / "latency.csv"

WIDTH = 19.2  # units of 36 points
# By the side on which a part is. Titles name the sides as well, so that grey print loses nothing.
HOST, CONTROLLER, OUTSIDE = "#d9e8f6", "#fbe6c8", "#ececec"
Point = tuple[float, float]


class Picture:
    """A drawing of a fixed size on white, in units from its lower left corner."""

    def __init__(self, height: float) -> None:
        svg.config.text = "text"  # so that labels can be searched and selected
        svg.config.useBatik = True  # baselines that every program places alike
        self.drawing = schemdraw.Drawing(canvas="svg", show=False)
        self.drawing.config(fontsize=13, font="Arial, Helvetica, sans-serif", lw=1.3, margin=0)
        self.area((0, 0), (WIDTH, height), color="white", fill="white")

    def area(self, lower: Point, upper: Point, title: str = "", color: str = "#777777", fill: str = "white") -> None:
        """Draw a rectangle behind everything, with a title in its upper left corner."""
        self.drawing.add(elm.Rect(lower, upper).at((0, 0)).theta(0).color(color).fill(fill).zorder(-1))
        if title:
            self.text((lower[0] + 0.2, upper[1] - 0.35), title, align="left")

    def box(self, centre: Point, width: float, height: float, text: str, fill: str = "white") -> None:
        """Draw a box with lines of text."""
        self.drawing.add(flow.Box(w=width, h=height).at(centre).anchor("center").theta(0).fill(fill))
        self.text(centre, text, size=13)

    def text(self, at: Point, text: str, size: float = 12, align: Halign = "center", color: str = "black") -> None:
        """Write lines of text, centred vertically."""
        lines = text.splitlines()
        for number, line in enumerate(lines):
            words = elm.Element().at(at).color(color).theta(0)
            lower = (number - (len(lines) - 1) / 2) * 1.2 * size / 36
            words.segments.append(SegmentText((0, -lower), line, fontsize=size, align=(align, "center")))
            self.drawing.add(words)

    def line(self, *points: Point, arrow: str = "->", dashed: bool = False) -> None:
        """Draw a line through points, with an arrow at its end."""
        for number, (start, end) in enumerate(pairwise(points), 2):
            at_end = arrow if number == len(points) else None
            self.drawing.add(elm.Line(arrow=at_end).at(start).to(end).linestyle("--" if dashed else "-"))

    def add(self, element: elm.Element) -> None:
        """Draw an element of schemdraw."""
        self.drawing.add(element)

    def save(self) -> str:
        """Return the SVG."""
        drawn = self.drawing.get_imagedata("svg").decode().replace("stroke-dasharray:-;", "")
        # Of coordinates, the digits that differ from one computer to another are none that anyone sees.
        return re.sub(r"-?\d+\.\d+", lambda number: f"{float(number[0]):.2f}".rstrip("0").rstrip("."), drawn) + "\n"


def data_path() -> Picture:
    """From a recording to the skin, with the bit rates of the example."""
    stream = vibrocast.encode(vibrocast.load(RECORDING), random_access=True)
    samples = f"{16 * stream.header.rate_hz / 1000:.1f} kbit/s"  # of 16 bits
    picture = Picture(7.6)
    picture.area((0.1, 4.5), (19.1, 7.5), "Host: Python")
    picture.area((0.1, 0.1), (12.6, 3.3))
    picture.text((6.4, 2.8), "Controller: C99, in integers")
    for x, text, below in (
        (2.0, "Recording or\nlive source", samples),
        (6.4, "Encoder", ""),
        (10.8, "Coded stream", f"{stream.bits_per_second / 1000:.1f} kbit/s"),
        (17.1, "Comparison,\nbit by bit", ""),
    ):
        picture.box((x, 5.9), 3.2, 1.2, text, HOST)
        picture.text((x, 5.0), below)
    for x, text, below in (
        (2.0, "Decoder", samples),
        (6.4, "Compensation\nand limits", ""),
        (10.8, "DAC", f"{PIEZO_STACK.dac_rate_hz} codes/s"),
    ):
        picture.box((x, 1.6), 3.2, 1.2, text, CONTROLLER)
        picture.text((x, 0.6), below)
    for x, text in ((14.6, "Actuator"), (17.9, "Skin")):
        picture.box((x, 1.6), 2.3, 1.2, text, OUTSIDE)
    for start, end in ((3.6, 4.8), (8.0, 9.2)):
        picture.line((start, 5.9), (end, 5.9))
        picture.line((start, 1.6), (end, 1.6))
    picture.line((12.4, 1.6), (13.45, 1.6))
    picture.line((15.75, 1.6), (16.75, 1.6))
    picture.line((10.8, 4.75), (10.8, 3.9), (2.0, 3.9), (2.0, 2.2))
    picture.text((6.4, 4.2), "serial port or USB")
    picture.line((10.8, 2.2), (10.8, 2.8), (17.1, 2.8), (17.1, 5.3), dashed=True)
    picture.text((14.7, 3.9), "samples and codes\nread back")
    return picture


ROLES = {
    "textures": "recordings, profiles",
    "device_protocol": "frames, messages, transports",
    "firmware": "C core, controller",
    "models": "trained models",
    "output": "actuators and limits",
    "codec": "signal to bytes and back",
    "simulated_device": "controllers without hardware",
    "evaluation": "benchmark",
    "export": "training",
    "harness": "bench, boards",
    "planner": "settings",
    "study": "listeners",
}
"""What each package is for."""


def levels() -> list[list[str]]:
    """Return the packages from the lowest layer up; each imports only from layers below."""
    found: list[list[str]] = []
    while len(below := {package for layer in found for package in layer}) < len(CORE):
        found.append([each for each, allowed in CORE.items() if each not in below and allowed <= below])
    return found


def architecture() -> Picture:
    """The packages in layers, and what each may import."""
    rows = [[_packaged(package) for package in layer] for layer in levels()]
    rows.append(
        [
            "host: players, live streams, uploads, the command\nimports all below",
            "vibrocast: the Python API\nimports host and below",
        ]
    )
    rows.append([f"{name}\n{ROLES[name]}" for name in sorted(PRODUCTS, key=lambda name: len(PRODUCTS[name]))])
    picture = Picture(1.4 * len(rows) + 0.2)
    for number, row in enumerate(rows):
        width = (WIDTH - 0.2) / len(row)
        for column, text in enumerate(row):
            fill = CONTROLLER if text.startswith("firmware") else HOST
            picture.box((0.1 + width * (column + 0.5), 0.8 + 1.4 * number), width - 0.2, 1.2, text, fill)
    return picture


def _packaged(package: str) -> str:
    """Return what the box of a package says."""
    if not CORE[package]:
        return f"{package}\n{ROLES[package]}"
    everything = len(CORE[package]) == len(CORE) - 1
    return f"{package}: {ROLES[package]}\nimports {'all below' if everything else ', '.join(sorted(CORE[package]))}"


Cell = tuple[str, str, float]
"""A field of bytes: its name, its size, and the width of its box."""


def cells(picture: Picture, left: float, middle: float, row: Sequence[Cell], fill: str) -> list[Point]:
    """Draw fields of bytes in a row, 1.3 high; return where each begins and ends."""
    ends = []
    for name, size, width in row:
        picture.box((left + width / 2, middle), width, 1.3, f"{name}\n{size}", fill)
        ends.append((left, left + width))
        left += width
    return ends


def unfold(picture: Picture, upper: Point, middle: float, lower: Point) -> None:
    """Draw that a field in a row of cells is the row below."""
    for start, end in zip(upper, lower, strict=True):
        picture.line((start, middle - 0.65), (end, middle - 1.55), arrow="", dashed=True)


def _field(message: type[messages.Message], name: str, width: float) -> Cell:
    """Return a field that the protocol declares."""
    (field,) = (each for each in wire_fields(message) if each.name == name)
    return name, getattr(field.wire, "name", ""), width


def frame() -> Picture:
    """A frame on the wire, and what is in it."""
    picture = Picture(11.8)
    longest = frames.MAX_PAYLOAD_BYTES
    picture.text((0.1, 10.9), "Frame", align="left")
    picture.text((0.1, 8.7), "Decoded", align="left")
    (whole, _) = cells(picture, 3.6, 10.9, [("COBS of payload and CRC-16", "", 13.2), ("zero", "1 byte", 2.2)], OUTSIDE)
    (payload, _) = cells(
        picture, 3.6, 8.7, [("payload", f"1 to {longest} bytes", 10.4), ("CRC-16", "2 bytes", 2.8)], OUTSIDE
    )
    unfold(picture, whole, 10.9, (3.6, 16.8))
    picture.text((0.1, 6.5), "Request,\nresponse", align="left")
    row = [("type", "u8", 2.0), ("sequence", "u16", 2.6), ("fixed part", "", 4.0), ("TLVs or rest", "", 5.6)]
    cells(picture, 3.6, 6.5, row, HOST)
    unfold(picture, payload, 8.7, (3.6, 17.8))
    picture.text((0.1, 4.3), "StreamData", align="left")
    data = messages.StreamData
    row = [("type", f"0x{data.TYPE:02X}", 2.0), _field(data, "stream", 2.0), _field(data, "iteration", 2.4)]
    row += [("length", "varint", 2.0), ("packet", "", 2.9), ("length", "varint", 2.0), ("packet …", "", 2.2)]
    ends = cells(picture, 3.6, 4.3, row, HOST)
    picture.text((0.1, 2.1), "Packet", align="left")
    cells(picture, 7.2, 2.1, PACKET, CONTROLLER)
    unfold(picture, ends[4], 4.3, (7.2, 17.8))
    picture.text((9.6, 0.7), "A TLV is a tag (u8), a length (u16) and a value. The zero ends the frame.")
    return picture


_PAYLOAD = ("payload of the codec", "", 5.4)
PACKET = [("sequence · 2 + refresh", "varint", 5.2), _PAYLOAD]


def stream_layout() -> Picture:
    """A file with a coded stream: header and packets."""
    picture = Picture(6.6)
    row = [("header", "", 5.4), ("packet", "", 3.2), ("CRC-16", "2 bytes", 2.4), ("packet", "", 3.0)]
    row += [("CRC-16 …", "2 bytes", 2.4)]
    header = [("format", "1 byte", 1.8), ("codec", "and length: 1", 2.4), ("flags", "1", 1.3), ("rate", "varint", 1.5)]
    header += [("samples", "varint", 1.9), ("gain", "2 a channel", 2.5), ("image hash", "0 or 4", 2.4)]
    header += [("length", "0 or 1", 1.7), ("configuration", "of the codec", 3.5)]
    picture.text((0.1, 5.5), "Packet", align="left")
    cells(picture, 3.6, 5.5, [("length · 2 + refresh", "varint", 5.2), _PAYLOAD], CONTROLLER)
    ends = cells(picture, 0.1, 3.3, row, OUTSIDE)
    unfold(picture, (3.6, 14.2), 5.5, ends[1])
    cells(picture, 0.1, 1.1, header, HOST)
    unfold(picture, ends[0], 3.3, (0.1, 19.1))
    return picture


def states() -> Picture:
    """The states of a controller, and what leads from one to the next."""
    picture = Picture(8.6)
    picture.area((8.0, 2.3), (15.65, 7.4), "the host must not fall silent", fill="#f7f7f7")
    places = {
        State.IDLE: (1.5, 5.4),
        State.BUFFERING: (5.7, 5.4),
        State.ARMED: (9.6, 5.4),
        State.PLAYING: (13.6, 5.4),
        State.FINISHED: (17.8, 5.4),
        State.PAUSED: (13.6, 3.1),
        State.WATCHDOG: (3.6, 3.1),
        State.STOPPED: (7.0, 0.8),
        State.FAULT: (16.4, 0.8),
    }
    for state, centre in places.items():
        fill = CONTROLLER if state in (State.ARMED, State.PLAYING, State.PAUSED) else "white"
        picture.add(flow.RoundBox(w=2.6, h=1.1).at(centre).anchor("center").theta(0).fill(fill))
        picture.text(centre, state.name, size=13)
    arrows = (
        ((1.5, 7.7), (1.5, 5.95), "restart", (1.5, 8.0)),
        ((2.8, 5.4), (4.4, 5.4), messages.Configure.__name__, (3.6, 5.75)),
        ((5.7, 7.7), (5.7, 5.95), f"{messages.Configure.__name__}, from any state", (5.7, 8.0)),
        ((7.0, 5.4), (8.3, 5.4), messages.Start.__name__, (7.5, 5.75)),
        ((10.9, 5.4), (12.3, 5.4), "time and\nprebuffer", (11.6, 6.35)),
        ((14.9, 5.4), (16.5, 5.4), "end", (16.1, 5.75)),
        ((13.2, 4.85), (13.2, 3.65), messages.Pause.__name__, (12.55, 4.25)),
        ((14.0, 3.65), (14.0, 4.85), messages.Resume.__name__, (14.8, 4.25)),
        ((8.0, 3.1), (4.9, 3.1), "silence for\nwatchdog_ms", (6.4, 3.6)),
        ((3.2, 0.8), (5.7, 0.8), messages.Stop.__name__, (4.4, 1.15)),
        ((12.2, 0.8), (15.1, 0.8), "hardware fails", (13.6, 1.15)),
    )
    for start, end, label, at in arrows:
        picture.line(start, end)
        picture.text(at, label)
    for x in (1.8, 10.8):
        picture.text((x, 0.8), "from any state")
    return picture


Step = tuple[type[messages.Message] | None, str]
"""A message and its contents; without a message, "" ends what another text has begun to repeat."""
_OF_CONTROLLER = messages.HelloResponse, messages.Status, messages.CaptureData, messages.FlashStatus
"""All others are the host's."""
_UNANSWERED = messages.StreamData, messages.SinglePacket


def sequence(steps: Sequence[Step], note: str) -> Picture:
    """Draw messages between host and controller from top to bottom; dashed ones answer no request."""
    host, controller = 2.6, 16.6
    bottom = 1.0
    at = top = bottom + 0.85 * len(steps) + 0.3
    picture = Picture(top + 1.1)
    looped = 0.0
    asked = False
    for message, contents in steps:
        at -= 0.85
        if message is not None:
            answers = message in _OF_CONTROLLER
            start, end = (controller, host) if answers else (host, controller)
            picture.line((start, at), (end, at), dashed=answers and not asked)
            picture.text(((host + controller) / 2, at + 0.28), f"{message.__name__}: {contents}")
            asked = not answers and message not in _UNANSWERED
        elif contents:
            looped = at
            picture.text((host + 0.2, at + 0.1), contents, align="left")
        else:
            at += 0.45
            picture.area((0.3, at + 0.1), (18.9, looped + 0.5), color="#777777")
    for x, name, fill in ((host, "Host", HOST), (controller, "Controller", CONTROLLER)):
        picture.box((x, top + 0.5), 3.8, 0.9, name, fill)
        picture.line((x, top + 0.05), (x, bottom + 0.1), arrow="")
    picture.text((WIDTH / 2, 0.45), note)
    return picture


def session() -> Picture:
    """How a recording is played."""
    return sequence(
        [
            (messages.Hello, "protocol version"),
            (messages.HelloResponse, "limits, actuator, codecs, model images"),
            (messages.Configure, "stream header, prebuffer, number of packets"),
            (messages.Status, f"{State.BUFFERING.name}, first credit"),
            (messages.Start, "device time"),
            (messages.Status, State.ARMED.name),
            (None, "until all packets are sent"),
            (messages.StreamData, "packets, as far as the credit reaches"),
            (messages.Status, f"{State.PLAYING.name}, position, more credit"),
            (None, ""),
            (messages.Status, State.FINISHED.name),
            (None, "while it plays and after, until all is read back"),
            (messages.CaptureRead, "tap, offset, count"),
            (messages.CaptureData, "decoded samples or DAC codes"),
            (None, ""),
        ],
        "Dashed: notifications. A live stream sends its first packet before Start, and ends with EndStream.",
    )


def upload() -> Picture:
    """How a model image is uploaded, tested and confirmed."""
    return sequence(
        [
            (messages.FlashBegin, "slot, size, SHA-256, hardware id"),
            (messages.FlashStatus, f"{SlotState.WRITING.name}, next offset"),
            (None, "until the slot has all bytes"),
            (messages.FlashData, "offset, piece of the image"),
            (messages.FlashStatus, f"{SlotState.WRITING.name}, next offset"),
            (None, ""),
            (messages.FlashVerify, "slot"),
            (messages.FlashStatus, f"{SlotState.VERIFIED.name}, SHA-256 of the slot"),
            (messages.FlashActivate, "slot"),
            (messages.FlashStatus, f"{SlotState.TESTING.name}; then the controller restarts into the slot"),
            (messages.Hello, "repeated until it is answered"),
            (messages.HelloResponse, f"slot {SlotState.TESTING.name}"),
            (messages.FlashConfirm, "slot"),
            (messages.FlashStatus, SlotState.CONFIRMED.name),
        ],
        "Without FlashConfirm, the next restart reverts to the slot that was confirmed before.",
    )


def wiring() -> Picture:
    """The board's pins, and two ways to drive an actuator."""
    about = " ".join(BOARD.read_text(encoding="utf-8").replace("*", " ").split())
    found = re.search(r"Pins: (\w+) and (\w+) \((\w+), (\w+)\).* (\w+) and (\w+) \((\w+), (\w+)\) are the DAC", about)
    assert found is not None, f"{BOARD} does not name its pins"
    send, receive, send_pin, receive_pin, first, second, first_pin, second_pin = found.groups()
    volts = PIEZO_STACK.volts
    amplifier: type[elm.Element] = dsp.Amp
    crystal: type[elm.Element2Term] = elm.Crystal
    picture = Picture(9.6)
    picture.box((3.0, 4.8), 5.0, 9.2, "")
    picture.text((1.9, 4.8), "Adafruit\nFeather\nSTM32F405\nExpress", size=13)
    picture.box((16.9, 8.0), 4.2, 2.6, "", HOST)
    picture.text((17.4, 8.0), "serial adapter,\n3.3 V,\n921 600 baud")
    rows = {send: (send_pin, 8.9), receive: (receive_pin, 8.0), "GND": ("", 7.1), first: (first_pin, 5.1)}
    for name, (pin, y) in {**rows, second: (second_pin, 2.4)}.items():
        picture.text((5.3, y), f"{name} ({pin})" if pin else name, align="right")
    for y, name, arrow in ((8.9, "RX", "->"), (8.0, "TX", "<-"), (7.1, "GND", "")):
        picture.line((5.5, y), (14.8, y), arrow=arrow)
        picture.text((14.95, y), name, align="left")
    picture.line((5.5, 5.1), (10.4, 5.1), arrow="")
    picture.text((7.6, 5.4), "0 to 3.3 V")
    picture.text((7.6, 4.8), "rest: 1.65 V")
    picture.add(amplifier().at((10.4, 5.1)).theta(0))
    picture.text((10.8, 6.2), f"amplifier, DC-coupled, gain {volts / 3.3:.0f}")
    picture.text((10.8, 3.4), "amplifier")
    picture.line((11.15, 5.1), (14.0, 5.1), arrow="")
    picture.add(crystal().at((14.0, 5.1)).to((14.0, 3.7)))
    picture.add(elm.Ground().at((14.0, 3.7)).theta(0))
    picture.text((14.6, 4.4), f"piezo stack: 0 to {volts:g} V,\nrest: {volts / 2:g} V", align="left")
    picture.add(elm.Capacitor().at((5.5, 2.4)).to((9.1, 2.4)))
    picture.text((7.3, 1.5), "blocks the 1.65 V;\ncorner below 20 Hz")
    picture.line((9.1, 2.4), (10.4, 2.4), arrow="")
    picture.add(amplifier().at((10.4, 2.4)).theta(0))
    picture.line((11.15, 2.4), (14.0, 2.4), arrow="")
    picture.add(elm.Inductor2(loops=3).at((14.0, 2.4)).to((14.0, 1.0)))
    picture.add(elm.Ground().at((14.0, 1.0)).theta(0))
    picture.text((14.6, 1.7), "or a voice coil or LRA:\nrest: 0 V", align="left")
    return picture


_BARS = (
    ("packet", ("packet",), "#1f4e79"),
    ("overlap of blocks", ("overlap",), "#5f97c9"),
    ("host and transport", ("wake", "encode", "send", "wire"), "#000000"),
    ("playout delay", ("buffer",), "#e4edf6"),
    ("output and DAC", ("drive", "dac"), "#f0ad4e"),
)
"""Parts of the delay as the picture groups them: label, parts in the table, fill."""


def delays(path: Path = DELAYS) -> dict[str, dict[str, float]]:
    """Return the delays on the simulated controller, ms, by command and part."""
    found: dict[str, dict[str, float]] = {"live": {}, "play": {}}
    for row in read_rows(path, Row):
        if row.device == "sim":
            found[row.command][row.part] = row.delay_ms
    return found


def latency() -> Picture:
    """Where the delays of a played and of a live stream come from."""
    measured = delays()
    codec = {part: measured["play"][part] for part in ("packet", "overlap")}
    picture = Picture(8.4)
    scale = 14.5 / 340
    for name, middle, units, parts in (
        ("play", 7.6, scale, measured["play"]),
        ("its codec\nalone", 6.2, scale, codec),
        ("live", 4.8, scale, measured["live"]),
        ("live,\nenlarged", 2.6, 10 * scale, measured["live"]),
    ):
        picture.text((0.1, middle), name, align="left")
        at = 2.5
        for label, names, fill in _BARS:
            delay_ms = sum(parts.get(each, 0.0) for each in names)
            width = units * delay_ms
            if width:
                picture.box((at + width / 2, middle), width, 0.9, "", fill)
            if width > 1.1:
                color = "white" if label == "packet" else "black"
                picture.text((at + width / 2, middle), f"{delay_ms:.{int(units > scale)}f}", color=color)
            at += width
        picture.text((at + 0.2, middle), f"{parts.get('total', sum(parts.values())):.0f} ms", size=13, align="left")
    for at, (label, _, fill) in zip((0.2, 2.9, 7.1, 11.5, 15.3), _BARS, strict=True):
        picture.box((at + 0.25, 0.7), 0.5, 0.5, "", fill)
        picture.text((at + 0.65, 0.7), label, align="left")
    return picture


PICTURES: dict[str, Callable[[], Picture]] = {
    "data_path": data_path,
    "architecture": architecture,
    "frame": frame,
    "stream": stream_layout,
    "states": states,
    "session": session,
    "upload": upload,
    "wiring": wiring,
    "latency": latency,
}


@page.drawing(FIGURES)
def main(out: Path) -> None:
    """Draw every picture."""
    out.mkdir(parents=True, exist_ok=True)
    for name, draw in PICTURES.items():
        with atomic_write(out / f"{name}.svg") as partial:
            partial.write_text(draw().save(), encoding="utf-8")
        click.echo(out / f"{name}.svg")


if __name__ == "__main__":
    main()
