"""The page that plays in a browser, in a real Chromium: every golden stream to the bit, the wire, sound and errors."""

import base64
import re
import shutil
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Browser, Page, expect

import vibrocast
from tests.device_protocol.test_messages import GOLDEN
from vibrocast import codec
from vibrocast.codec.stream import Stream
from vibrocast.device_protocol import messages
from vibrocast.device_protocol.coded_stream import PROFILE_UNIT, pack_file, unpack_file
from vibrocast.firmware.build import build
from vibrocast.simulated_device.controller import Controller, Settings
from vibrocast.simulated_device.socket_port import SocketPort

pytest.importorskip("mkdocs", reason="needs the extra docs")
from studies import browser_page

pytestmark = pytest.mark.slow
ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "tutorials" / "browser.md"
SCRIPTS = ROOT / "docs" / "javascripts"
# Only hosts decode these.
OTHERS = ("dct_whole",)
GOLDEN_STREAMS = sorted(
    path for path in (ROOT / "tests" / "codec").glob("golden_*.vct") if path.stem.removeprefix("golden_") not in OTHERS
)
# A port of WebSerial whose other end is in this process.
PORT = """
const port = {
    readable: null, writable: null, pulled: false,
    async open() {
        this.readable = new ReadableStream({
            pull: async (stream) => {
                for (;;) {
                    if (this.pulled) {
                        this.readable = null;
                        return stream.error(new DOMException("lost", "NetworkError"));
                    }
                    const data = await readWire();
                    if (data) return stream.enqueue(Uint8Array.from(atob(data), (each) => each.charCodeAt(0)));
                }
            },
        }, { highWaterMark: 0 });
        this.writable = new WritableStream({
            write: async (bytes) => {
                if (this.pulled) throw new DOMException("lost", "NetworkError");
                await writeWire(btoa(String.fromCharCode(...bytes)));
            },
        });
    },
    async close() {},
};
Object.defineProperty(navigator, "serial", { value: { requestPort: async () => port }, configurable: true });
"""


def encoded(data: bytes) -> str:
    return base64.b64encode(data).decode()


def image_of(path: Path) -> bytes | None:
    name = path.stem.removesuffix("_steered")
    image = path.with_name(f"{name}.vcmi")
    return image.read_bytes() if image.exists() else None


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the page's address: the player as in the site, without the site's theme."""
    folder = tmp_path_factory.mktemp("site")
    for name in ("javascripts", "stylesheets"):
        shutil.copytree(ROOT / "docs" / name, folder / name)
    (folder / browser_page.SCRIPT).write_text(browser_page.script())
    text = PAGE.read_text(encoding="utf-8")
    last = '<script src="../javascripts/player.js"></script>'
    player = text[text.index("<link") : text.index(last) + len(last)]
    (folder / "tutorials").mkdir()
    made = folder / "tutorials" / "browser.html"
    made.write_text(f'<!doctype html><html lang="en"><meta charset="utf-8"><body>{player}</body></html>', "utf-8")
    return made


@contextmanager
def opened(browser: Browser, site: Path, prepare: Callable[[Page], object] | None = None) -> Iterator[Page]:
    """Open the page from the disk; no script in it may fail."""
    page = browser.new_page()
    page.set_default_timeout(60_000)
    failures: list[str] = []
    page.on("pageerror", lambda failure: failures.append(str(failure)))
    if prepare is not None:
        prepare(page)
    page.goto(site.as_uri())
    expect(part(page, "codec")).to_have_text("mdct")
    try:
        yield page
    finally:
        page.close()
    assert failures == []


@pytest.fixture(scope="module")
def page(browser: Browser, site: Path) -> Iterator[Page]:
    with opened(browser, site) as page:
        yield page


def part(page: Page, name: str) -> Any:
    return page.locator(f"[data-vc={name}]")


def choose(page: Page, *files: tuple[str, bytes]) -> None:
    part(page, "file").set_input_files(
        [{"name": name, "mimeType": "application/octet-stream", "buffer": data} for name, data in files]
    )


# ---- the core ----


@pytest.mark.parametrize("path", GOLDEN_STREAMS, ids=lambda path: path.stem)
def test_golden_streams_decode_to_the_hosts_samples(page: Page, path: Path) -> None:
    assert_decodes(page, Stream.from_bytes(path.read_bytes(), image_of(path)))


def test_a_file_of_one_packet_and_a_profile(page: Page) -> None:
    oak = vibrocast.encode(vibrocast.load(ROOT / "examples" / "oak.wav"))
    assert len(oak.packets) == 1
    assert_decodes(page, oak)
    assert_decodes(page, replace(oak, header=replace(oak.header, unit=PROFILE_UNIT, samples=None)))


def assert_decodes(page: Page, stream: Stream) -> None:
    """The browser reads and decodes a stream as the host does."""
    decoded = page.evaluate(
        """async ([file, image]) => {
            const { core } = await player;
            const stream = core.read(fromBase64(file));
            const { integers, packetSamples, delaySamples, samples } = core.decode(stream, fromBase64(image));
            return { integers: Array.from(integers), packetSamples, delaySamples, samples,
                header: Array.from(stream.header), packets: stream.packets.map((each) => Array.from(each)) };
        }""",
        [encoded(bytes(stream)), encoded(stream.image or b"")],
    )
    assert np.array_equal(decoded["integers"], stream.decode_integers().ravel())
    assert (decoded["packetSamples"], decoded["delaySamples"]) == (stream.packet_samples, stream.delay_samples)
    assert decoded["samples"] == stream.samples
    assert bytes(decoded["header"]) == stream.header.pack()
    assert tuple(map(bytes, decoded["packets"])) == stream.packets


def test_module_is_as_large_as_the_page_says_and_imports_nothing(page: Page) -> None:
    imports = page.evaluate("WebAssembly.Module.imports(new WebAssembly.Module(fromBase64(PLAYER_DATA.core)))")
    assert imports == []
    stated = re.search(r"module of the core, (\d+) kB", PAGE.read_text(encoding="utf-8"))
    assert stated is not None
    assert build("wasm").stat().st_size == pytest.approx(1000 * int(stated[1]), rel=0.02)


# ---- messages ----


@pytest.mark.parametrize(("message", "packed"), GOLDEN, ids=lambda value: type(value).__name__)
def test_messages_have_their_golden_bytes(page: Page, message: messages.Message, packed: str) -> None:
    found = page.evaluate(
        """(bytes) => {
            const { name, values, sequence } = unpackMessage(Uint8Array.from(bytes));
            return [name, Array.from(packMessage(name, values, sequence))];
        }""",
        list(bytes.fromhex(packed)),
    )
    assert found[0] == type(message).__name__
    assert bytes(found[1]).hex() == packed


# ---- the page ----


def test_the_slider_changes_the_rate_and_the_page_states_rate_and_snr(browser: Browser, site: Path) -> None:
    data = browser_page.example("sandpaper")
    original = np.frombuffer(base64.b64decode(data["original"]), "<f4").reshape(-1, 1)
    with opened(browser, site) as page:
        part(page, "example").select_option(label="A probe over sandpaper")
        for rate, coded in enumerate(data["streams"]):
            part(page, "rate").fill(str(rate))
            stream = Stream.from_bytes(base64.b64decode(coded))
            snr_db = codec.snr_db(original, stream.decode())
            expect(part(page, "bits")).to_have_text(f"{stream.bits_per_second:.0f} bit/s")
            expect(part(page, "snr")).to_have_text(f"{snr_db:.2f} dB")


def test_files_of_the_reader(browser: Browser, site: Path) -> None:
    folder = ROOT / "tests" / "codec"
    mdct, eva = ((folder / f"golden_{name}.vct").read_bytes() for name in ("mdct", "eva_static"))
    header, packets = unpack_file(mdct)
    unknown = pack_file(replace(header, codec_identifier=5), packets)
    image, other = ((folder / f"golden_eva_{name}.vcmi").read_bytes() for name in ("static", "adaptive"))
    with opened(browser, site) as page:
        choose(page, ("golden_mdct.vct", mdct))
        expect(part(page, "snr")).to_have_text("unknown: no original here")
        expect(part(page, "rate")).to_be_disabled()
        choose(page, ("stream.vct", eva), ("model.vcmi", image))
        expect(part(page, "codec")).to_have_text("eva")
        for files, problem in (
            ([("stream.vct", eva)], "needs the model .* Choose the stream and its .vcmi file together"),
            ([("stream.vct", eva), ("model.vcmi", other)], "coded for a model image: give that image"),
            ([("oak.wav", b"RIFF" + bytes(90))], "This is no coded stream: .* Choose a .vct file"),
            ([("cut.vct", mdct[:-3])], "The file is damaged: .* Copy it again."),
            ([("unknown.vct", unknown)], "lacks the stream's codec. Use vibrocast decode"),
            ([("two.vct", b""), ("three.vct", b"")], "needs one .vct file"),
        ):
            choose(page, *files)
            expect(part(page, "problem")).to_have_text(re.compile(problem))
        expect(part(page, "codec")).to_have_text("eva")  # the last one that could be decoded
        part(page, "example").select_option(label="A stylus across oak")
        expect(part(page, "problem")).to_have_text("")
        expect(part(page, "codec")).to_have_text("mdct")


def test_sound_starts_low_fades_and_stops(browser: Browser, site: Path) -> None:
    with opened(browser, site) as page:
        expect(part(page, "level-text")).to_have_text("-30 dB")
        part(page, "play").click()
        expect(part(page, "sound")).to_have_text("Playing.")
        assert page.evaluate("player.then(({ sound }) => sound.level.gain.value)") == pytest.approx(10**-1.5, rel=1e-3)
        assert page.evaluate("player.then(({ sound }) => sound.fade.gain.value)") <= 1
        part(page, "level").fill("-60")
        expect(part(page, "level-text")).to_have_text("silent")
        part(page, "stop").click()
        expect(part(page, "sound")).to_have_text("Played.")
        expect(part(page, "play")).to_be_enabled()


@pytest.mark.parametrize(("from_hz", "to_hz"), [(2800, 48_000), (48_000, 44_100)])
def test_resampling_keeps_a_sine(page: Page, from_hz: int, to_hz: int) -> None:
    time_s = np.arange(from_hz // 4) / from_hz
    made = page.evaluate(
        "([samples, from, to]) => Array.from(resampled(Float64Array.from(samples), from, to))",
        [np.sin(2 * np.pi * 200 * time_s).tolist(), from_hz, to_hz],
    )
    required = np.sin(2 * np.pi * 200 * np.arange(len(made)) / to_hz)
    inner = slice(len(made) // 4, -len(made) // 4)
    assert np.max(np.abs(np.array(made)[inner] - required[inner])) < 0.005


# ---- the controller ----


@contextmanager
def wired(browser: Browser, site: Path, controller: Controller) -> Iterator[Page]:
    """Open the page with a port that leads to a simulated controller."""
    with (
        SocketPort(controller) as port,
        connected(port) as wire,
        opened(browser, site, lambda page: bridge(page, wire)) as page,
    ):
        yield page


def connected(port: SocketPort) -> socket.socket:
    """Return a connection to the port of a controller."""
    host, number = port.name.removeprefix("socket://").split(":")
    wire = socket.create_connection((host, int(number)))
    wire.settimeout(0.005)
    return wire


def bridge(page: Page, wire: socket.socket | None) -> None:
    """Give a page a serial port that leads to a controller, or to nothing that answers."""

    def read() -> str:
        try:
            return encoded(wire.recv(65_536)) if wire else ""
        except OSError:  # nothing came, or the test has closed the wire
            return ""

    def write(data: str) -> None:
        if wire:
            wire.sendall(base64.b64decode(data))

    page.expose_function("writeWire", write)
    page.expose_function("readWire", read)
    page.add_init_script(PORT)


def test_an_example_plays_on_a_controller_of_a_small_buffer_and_again_after_a_stop(
    browser: Browser, site: Path
) -> None:
    small = Settings(buffer_samples=2 * browser_page.PACKET_SAMPLES)
    with wired(browser, site, Controller(small)) as page:
        part(page, "example").select_option(label="Cloth under two fingers")
        part(page, "connect").click()
        expect(part(page, "device")).to_have_text(re.compile("Connected to simulated"))
        part(page, "send").click()
        expect(part(page, "device")).to_have_text(re.compile("^playing"))
        part(page, "halt").click()
        expect(part(page, "device")).to_have_text("Stopped.")
        part(page, "send").click()
        played = re.compile(r"Played, 0 underrun\(s\), 0 lost packet\(s\)\. All \d+ samples are equal")
        expect(part(page, "device")).to_have_text(played, timeout=60_000)
        expect(part(page, "problem")).to_have_text("")
        part(page, "disconnect").click()
        expect(part(page, "device")).to_have_text("Not connected.")


def test_a_pulled_controller(browser: Browser, site: Path) -> None:
    with wired(browser, site, Controller()) as page:
        part(page, "connect").click()
        part(page, "send").click()
        expect(part(page, "device")).to_have_text(re.compile("^playing"))
        page.evaluate("navigator.serial.requestPort().then((port) => { port.pulled = true; })")
        expect(part(page, "problem")).to_have_text(re.compile("The controller is gone: .* connect again"))
        expect(part(page, "device")).to_have_text("Not connected.")
        expect(part(page, "connect")).to_be_enabled()


def test_a_device_that_does_not_answer(browser: Browser, site: Path) -> None:
    with opened(browser, site, lambda page: bridge(page, None)) as page:
        part(page, "connect").click()
        expect(part(page, "problem")).to_have_text(
            re.compile("The controller does not answer: .* choose its port again")
        )
        expect(part(page, "device")).to_have_text("Not connected.")


def test_a_controller_that_rejects_a_stream(browser: Browser, site: Path) -> None:
    with wired(browser, site, Controller(Settings(channels=1))) as page:
        part(page, "example").select_option(label="Cloth under two fingers")
        part(page, "connect").click()
        part(page, "send").click()
        expect(part(page, "problem")).to_have_text(re.compile("The controller rejects the request: .*channels"))


@pytest.mark.parametrize(
    ("serial", "text"),
    [
        ("undefined", "This browser has no WebSerial, .* Use Chromium"),
        ("{ requestPort() { throw new DOMException('', 'NotFoundError'); } }", "No port was chosen. Plug"),
        (
            "{ requestPort: () => ({ open() { throw Error('Busy.'); } }) }",
            "cannot be opened: Busy. Close other programs",
        ),
    ],
)
def test_a_browser_without_a_port(browser: Browser, site: Path, serial: str, text: str) -> None:
    script = f"Object.defineProperty(navigator, 'serial', {{ value: {serial} }});"
    with opened(browser, site, lambda page: page.add_init_script(script)) as page:
        part(page, "connect").click()
        expect(part(page, "problem")).to_have_text(re.compile(text))


# ---- the pages that a reader writes ----


def test_the_readers_pages_play_sound_and_on_a_controller(browser: Browser, tmp_path: Path) -> None:
    for name in ("messages.js", "vibrocast.js"):
        shutil.copy(SCRIPTS / name, tmp_path)
    shutil.copy(build("wasm"), tmp_path / "wasm.wasm")
    shutil.copy(ROOT / "tests" / "codec" / "golden_mdct.vct", tmp_path / "texture.vct")
    pages = re.findall(r"```html\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    handler = partial(SimpleHTTPRequestHandler, directory=tmp_path)
    with (
        ThreadingHTTPServer(("localhost", 0), handler) as serving,
        SocketPort(Controller()) as port,
        connected(port) as wire,
    ):
        threading.Thread(target=serving.serve_forever, daemon=True).start()
        for text, shown in zip(pages, (r"Play(ing|ed)\.", r"Played, 0 underruns\."), strict=True):
            (tmp_path / "page.html").write_text(text)
            with closing(browser.new_page()) as page:
                bridge(page, wire)
                page.goto(f"http://localhost:{serving.server_port}/page.html")
                page.locator("button").click()
                expect(page.locator("output")).to_have_text(re.compile(shown), timeout=60_000)
        serving.shutdown()
