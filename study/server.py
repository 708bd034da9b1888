"""Serves the pages of a run: the participant's, and the experimenter's at an address that nobody can guess."""

import secrets
import socket
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from vibrocast.files import plain
from vibrocast.harness.web_server import Page, Refused, Request, json_page, web_server
from vibrocast.host.controller import ControllerError
from vibrocast.study.session import Session
from vibrocast.study.trials import Break, Message, Paused, Question, Rejected, Screen, Trial

NOISE_RATE_HZ = 48_000
"""Of the masking noise; the page knows it too."""
CALL_THE_EXPERIMENTER = "Please call the experimenter."

_PAGES = Path(__file__).with_name("page")
_POLL_S, _MAX_WAIT_S = 0.04, 15.0
_LINGER_S, _END_S = 2.0, 5.0
"""How long after its end a run's pages show the last screen, and how long a request that is under way may go on."""

_Identity = Annotated[str, Meta(max_length=500)]


class _OnScreen(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A request of the participant. `screen`: the identity of the screen that the page shows."""

    screen: _Identity


class _Play(_OnScreen, frozen=True):
    label: Annotated[str, Meta(max_length=100)]


class _Answer(_OnScreen, frozen=True):
    values: Annotated[list[Annotated[int, Meta(ge=-(10**6), le=10**6)]], Meta(max_length=100)]


class _Reply(_OnScreen, frozen=True):
    text: Annotated[str, Meta(max_length=2000)]


@dataclass(frozen=True)
class Aids:
    """Sound and pace with which the participant's page goes along with a trial.

    Attributes:
        stimulus_seconds: For about so long each texture plays. None: unknown.
        masking_noise_dbfs: RMS level of noise, re the full scale of the headphones' sound card. None: no noise.
        masking_noise_spectrum: "white" or "pink".
        strokes_per_minute: Pace of the hand that a dot and ticks give. None: no pace.
    """

    stimulus_seconds: float | None = None
    masking_noise_dbfs: float | None = None
    masking_noise_spectrum: str = "white"
    strokes_per_minute: float | None = None


def masking_noise(spectrum: str) -> NDArray[np.float32]:
    """Return 10 s of noise at NOISE_RATE_HZ with an RMS of 1: float32 (n,), which repeats without a seam.

    White noise has the same power in each Hz from 20 Hz on, and pink noise in each octave: 3 dB less in each Hz with
    each octave. Headphones play nothing below 20 Hz.
    """
    count = 10 * NOISE_RATE_HZ
    frequency_hz = np.fft.rfftfreq(count, 1 / NOISE_RATE_HZ)
    amplitude = np.zeros(len(frequency_hz))
    heard = frequency_hz >= 20
    amplitude[heard] = frequency_hz[heard] ** (-0.5 if spectrum == "pink" else 0.0)
    phase = np.random.default_rng(0).uniform(0, 2 * np.pi, len(frequency_hz))
    samples = np.fft.irfft(amplitude * np.exp(1j * phase), count)
    return np.asarray(samples / np.sqrt(np.mean(samples**2)), np.float32)


class StudyPages:
    """The pages of a run and their requests. `token`: the secret part of the experimenter's address."""

    def __init__(self, run: Session, aids: Aids) -> None:
        self.token = secrets.token_urlsafe(16)
        self.closing = False
        self._run = run
        self._aids = aids
        self.turn = threading.Lock()  # of the participant's requests: two pages cannot answer one trial
        self._fault: str | None = None
        self._is_pause_wanted = False  # by the experimenter; a run whose device is gone pauses by itself
        self._seen: float | None = None
        self._instance = secrets.token_urlsafe(4)  # another process may reach the same version
        acts: dict[str, tuple[type[_OnScreen], Callable[[Any], bool | None]]] = {
            "play": (_Play, lambda given: run.play(given.label)),
            "stop": (_OnScreen, lambda _given: run.stop_playing()),
            "answer": (_Answer, lambda given: run.answer(tuple(given.values))),
            "go_on": (_OnScreen, lambda _given: run.go_on()),
            "reply": (_Reply, lambda given: run.reply(plain(given.text))),
        }
        controls = {"pause": self._pause, "resume": self._resume, "abort": run.abort}
        self._routes: dict[str, Callable[[Request], Page]] = {
            "GET /": lambda _request: Page((_PAGES / "participant.html").read_bytes()),
            "GET /api/screen": self._participant_screen,
            "GET /api/noise": self._noise,
            **{f"POST /api/{name}": partial(self._act, *act) for name, act in acts.items()},
            # Only behind the token; `answer` puts it in front.
            "GET experimenter": lambda _request: Page((_PAGES / "experimenter.html").read_bytes()),
            "GET experimenter/state": self._experimenter_state,
            **{f"POST experimenter/{name}": partial(self._control, act) for name, act in controls.items()},
        }

    def answer(self, request: Request) -> Page:
        """Answer a request, from any thread. Raises Refused."""
        path = request.path
        match path.split("/", 3):
            case ["", "experimenter", token, *rest] if secrets.compare_digest(token.encode(), self.token.encode()):
                path = "/".join(["experimenter", *rest])
        act = self._routes.get(f"{request.method} {path}")
        if act is None:
            raise Refused(404, "no such page")
        return act(request)

    def _version(self) -> str:
        return f"{self._instance}.{self._run.version()}.{self._fault is not None:d}"

    def _act(self, kind: type[_OnScreen], act: Callable[[Any], bool | None], request: Request) -> Page:
        """Do what the participant asks for, unless the page shows another screen."""
        try:
            given = msgspec.json.decode(request.body, type=kind)
        except (msgspec.DecodeError, RecursionError) as reason:  # ValidationError is a DecodeError
            raise Refused(400, str(reason)) from reason
        with self.turn:
            if self.closing or given.screen != _identity(self._run.state().participant, self._run.screen()):
                raise Refused(409, "this screen has passed")
            return json_page({"correct": self._try(lambda: act(given), CALL_THE_EXPERIMENTER)})

    def _control(self, act: Callable[[], None], _request: Request) -> Page:
        """Do what the experimenter asks for."""
        self._try(act)
        return json_page({})

    def _participant_screen(self, request: Request) -> Page:
        """Send what the participant's page shows: never a condition, a stimulus or a fact."""
        self._seen = time.monotonic()
        version = self._changed_version(request)
        self._seen = time.monotonic()
        state, screen = self._run.state(), self._run.screen()
        shown = {"id": _identity(state.participant, screen)} | _shown(screen)
        if isinstance(screen, Paused) and not self._is_pause_wanted:
            shown["text"] = CALL_THE_EXPERIMENTER
        plays = dict(self._run.plays()) if isinstance(screen, Trial) else {}
        now = {"version": version, "screen": shown, "playing": state.now_playing, "plays": plays, "ended": state.ended}
        return json_page(now | {"aids": asdict(self._aids)})

    def _experimenter_state(self, request: Request) -> Page:
        version = self._changed_version(request)
        state = self._run.state()
        fault = self._fault
        if state.paused and not self._is_pause_wanted:
            fault = fault or next(reversed(state.warnings), "the run has paused by itself; press Resume")
        seen_s = None if self._seen is None else round(time.monotonic() - self._seen, 1)
        return json_page(asdict(state) | {"version": version, "fault": fault, "page_seen_s": seen_s})

    def _noise(self, _request: Request) -> Page:
        """Send the masking noise as float32, little endian."""
        if self._aids.masking_noise_dbfs is None:
            raise Refused(404, "this study has no masking noise")
        samples = masking_noise(self._aids.masking_noise_spectrum)
        return Page(samples.astype("<f4").tobytes(), "application/octet-stream")

    def _pause(self) -> None:
        self._is_pause_wanted = True
        self._run.pause()

    def _resume(self) -> None:
        self._run.resume()
        self._is_pause_wanted = False
        self._fault = None

    def _changed_version(self, request: Request) -> str:
        """Return the version, first of all: a later change shows as a new one.

        Waits for some seconds at most until it differs from the one that the page states.
        """
        end_s = time.monotonic() + _MAX_WAIT_S
        while (version := self._version()) == request.query.get("version") and time.monotonic() < end_s:
            if self.closing or request.is_gone():
                break
            time.sleep(_POLL_S)
        return version

    def _try(self, act: Callable[[], bool | None], shown: str | None = None) -> bool | None:
        """Return what an action gives. A failure of device or disk pauses the run, and shows to the experimenter.

        `shown`: in place of the reason, for the participant.
        """
        try:
            return act()
        except Rejected as reason:
            raise Refused(422, str(reason)) from reason
        except (ControllerError, OSError) as reason:  # TransportError is an OSError
            self._fault = plain(str(reason))
            with suppress(OSError):  # a full disk takes no log either
                self._run.pause()
            raise Refused(503, shown or self._fault) from reason


def serve(
    run: Session,
    host: str = "127.0.0.1",
    port: int = 8017,
    aids: Aids = Aids(),
    say: Callable[[str], None] = print,
) -> None:
    """Serve the pages until the run has ended or an exception, such as KeyboardInterrupt, ends it; the actuator rests.

    `host`: the address that is bound; "0.0.0.0" lets tablets of the same network in. `port`: 0 takes a free one.
    `say` gets a line for each address. Raises InputError if the address cannot be bound.
    """
    pages = StudyPages(run, aids)
    with web_server(pages.answer, host, port, failed=CALL_THE_EXPERIMENTER) as port:
        try:
            for address in _addresses(host, port):
                say(f"participant: {address}/")
                say(f"experimenter: {address}/experimenter/{pages.token}")
            while not run.state().ended:
                time.sleep(0.1)
            time.sleep(_LINGER_S)
        finally:
            pages.closing = True
            with suppress(OSError):  # a full disk takes no log; the actuator rests all the same
                run.stop_playing()
            if pages.turn.acquire(timeout=_END_S):  # a request that was under way may have begun to play
                pages.turn.release()
            with suppress(OSError):
                run.stop_playing()


def _addresses(host: str, port: int) -> list[str]:
    """Return the addresses of the pages: of this machine in its network where `host` stands for all."""
    names = [host]
    if host in ("0.0.0.0", "::"):
        names = ["127.0.0.1"]
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            try:
                probe.connect(("192.0.2.1", 9))  # RFC 5737: an address of nobody; a datagram socket sends nothing here
                names = [probe.getsockname()[0]]
            except OSError:
                pass  # no network: only this machine reaches the pages
    return [f"http://[{name}]:{port}" if ":" in name else f"http://{name}:{port}" for name in names]


def _identity(participant: int, screen: Screen) -> str:
    """Return what tells a screen from others, also after a restart: pages state it in each request."""
    match screen:
        case Trial():
            what = f"trial {screen.number}"
        case Message():
            what = f"{screen.kind} {screen.title}"
        case Question():
            what = f"question {screen.name}"
        case Break():
            what = f"break {screen.done}"
        case Paused():
            what = "paused"
    return f"{participant} {what}"[:500]


def _shown(screen: Screen) -> dict[str, Any]:
    """Return the parts of a screen that the participant may see."""
    kind = type(screen).__name__.lower()
    if not isinstance(screen, Trial):
        return asdict(screen) | {"type": kind}
    names = ("number", "total", "phase", "question", "max_plays", "in_order", "switches", "pause_s", "max_seconds")
    return {name: getattr(screen, name) for name in names} | {
        "type": kind,
        "labels": [interval.label for interval in screen.intervals],
        "response": asdict(screen.response) | {"type": type(screen.response).__name__.lower()},
    }
