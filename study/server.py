"""Serves the pages of a run: the participant's, and the experimenter's at an address that nobody can guess."""

import asyncio
import ipaddress
import secrets
import socket
import threading
import time
from collections.abc import Awaitable, Callable
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, TypeVar
from urllib.parse import urlsplit

import msgspec
import numpy as np
import uvicorn
from msgspec import Meta
from numpy.typing import NDArray
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.middleware.base import BaseHTTPMiddleware
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from vibrocast.errors import InputError
from vibrocast.files import plain
from vibrocast.host.controller import ControllerError
from vibrocast.study.session import Session
from vibrocast.study.trials import Break, Message, Paused, Question, Rejected, Screen, Trial

DEFAULT_HOST = "127.0.0.1"
DEFAULT_PORT = 8017
NOISE_RATE_HZ = 48_000
"""Of the masking noise; the page knows it too."""
CALL_THE_EXPERIMENTER = "Please call the experimenter."

_PAGES = Path(__file__).with_name("page")
_HEADERS = {
    # The pages hold their own script and style, and load nothing else.
    "Content-Security-Policy": "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; "
    "connect-src 'self'; img-src data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "Cache-Control": "no-store",
    "Referrer-Policy": "no-referrer",  # the experimenter's address is a secret
    "X-Content-Type-Options": "nosniff",
}
_MAX_BODY_BYTES = 1 << 16
_MAX_BODY_S = 5.0
_MAX_CONNECTIONS = 64
_POLL_S = 0.04
_MAX_WAIT_S = 15.0
_LINGER_S = 2.0
"""For so long the pages are served after the run has ended, so that they show its last screen."""

_Identity = Annotated[str, Meta(max_length=500)]
_Request = TypeVar("_Request", bound="_OnScreen")


class _OnScreen(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A request of the participant. `screen`: the identity of the screen that the page shows."""

    screen: _Identity


class _Play(_OnScreen, frozen=True):
    label: Annotated[str, Meta(max_length=100)]


class _Answer(_OnScreen, frozen=True):
    values: Annotated[list[Annotated[int, Meta(ge=-(10**6), le=10**6)]], Meta(max_length=100)]


class _Reply(_OnScreen, frozen=True):
    text: Annotated[str, Meta(max_length=2000)]


class _Nothing(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A request of the experimenter."""


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
        self._turn = threading.Lock()  # of the participant's requests: two pages cannot answer one trial
        self._fault: str | None = None
        self._is_pause_wanted = False  # by the experimenter; a run whose device is gone pauses by itself
        self._seen: float | None = None
        self._instance = secrets.token_urlsafe(4)  # another process may reach the same version

    def application(self) -> Starlette:
        """Return the web application."""
        secret = "/experimenter/{token}"
        return Starlette(
            routes=[
                Route("/", self._page("participant.html")),
                Route("/api/screen", self._participant_screen),
                Route("/api/noise", self._noise),
                *(self._participant_action(*action) for action in self._participant_actions()),
                Route(secret, self._only_experimenter(self._page("experimenter.html"))),
                Route(f"{secret}/state", self._only_experimenter(self._experimenter_state)),
                *(
                    Route(f"{secret}/{name}", self._only_experimenter(self._experimenter_action(act)), methods=["POST"])
                    for name, act in (("pause", self._pause), ("resume", self._resume), ("abort", self._run.abort))
                ),
            ],
            middleware=[Middleware(BaseHTTPMiddleware, dispatch=_guard)],
            exception_handlers={HTTPException: _http_error, Exception: _defect},
        )

    def participant_screen(self) -> dict[str, Any]:
        """Return what the participant's page shows: never a condition, a stimulus or a fact."""
        version = self._version()  # first: a later change shows as a new version
        state, screen = self._run.state(), self._run.screen()
        shown = {"id": _identity(state.participant, screen)} | _shown(screen)
        if isinstance(screen, Paused) and not self._is_pause_wanted:
            shown["text"] = CALL_THE_EXPERIMENTER
        return {
            "version": version,
            "screen": shown,
            "playing": state.now_playing,
            "plays": dict(self._run.plays()) if isinstance(screen, Trial) else {},
            "ended": state.ended,
            "aids": asdict(self._aids),
        }

    def experimenter_state(self) -> dict[str, Any]:
        """Return what the experimenter's page shows."""
        version = self._version()
        state = self._run.state()
        fault = self._fault
        if state.paused and not self._is_pause_wanted:
            fault = fault or next(reversed(state.warnings), "the run has paused by itself; press Resume")
        seen_s = None if self._seen is None else round(time.monotonic() - self._seen, 1)
        return asdict(state) | {"version": version, "fault": fault, "page_seen_s": seen_s}

    def _version(self) -> str:
        return f"{self._instance}.{self._run.version()}.{self._fault is not None:d}"

    def _participant_actions(self) -> list[tuple[str, type[_OnScreen], Callable[[Any], bool | None]]]:
        run = self._run
        return [
            ("play", _Play, lambda given: run.play(given.label)),
            ("stop", _OnScreen, lambda _given: run.stop_playing()),
            ("answer", _Answer, lambda given: run.answer(tuple(given.values))),
            ("go_on", _OnScreen, lambda _given: run.go_on()),
            ("reply", _Reply, lambda given: run.reply(plain(given.text))),
        ]

    def _participant_action(self, name: str, kind: type[_Request], act: Callable[[_Request], bool | None]) -> Route:
        async def endpoint(request: Request) -> Response:
            given = await _read(request, kind)

            def in_turn() -> bool | None:
                with self._turn:
                    if self.closing or given.screen != _identity(self._run.state().participant, self._run.screen()):
                        raise HTTPException(409, "this screen has passed")
                    return act(given)

            return JSONResponse({"correct": await self._try(in_turn, CALL_THE_EXPERIMENTER)})

        return Route(f"/api/{name}", endpoint, methods=["POST"])

    async def _participant_screen(self, request: Request) -> Response:
        self._seen = time.monotonic()
        await self._wait_for_change(request)
        self._seen = time.monotonic()
        return JSONResponse(await run_in_threadpool(self.participant_screen))

    async def _noise(self, _request: Request) -> Response:
        """Send the masking noise as float32, little endian."""
        if self._aids.masking_noise_dbfs is None:
            raise HTTPException(404, "this study has no masking noise")
        samples = await run_in_threadpool(masking_noise, self._aids.masking_noise_spectrum)
        return Response(samples.astype("<f4").tobytes(), media_type="application/octet-stream")

    def _only_experimenter(
        self, endpoint: Callable[[Request], Awaitable[Response]]
    ) -> Callable[[Request], Awaitable[Response]]:
        async def checked(request: Request) -> Response:
            if not secrets.compare_digest(request.path_params["token"].encode(), self.token.encode()):
                raise HTTPException(404, "not found")
            return await endpoint(request)

        return checked

    async def _experimenter_state(self, request: Request) -> Response:
        await self._wait_for_change(request)
        return JSONResponse(await run_in_threadpool(self.experimenter_state))

    def _experimenter_action(self, act: Callable[[], None]) -> Callable[[Request], Awaitable[Response]]:
        async def endpoint(request: Request) -> Response:
            await _read(request, _Nothing)
            await self._try(act)
            return JSONResponse({})

        return endpoint

    def _rest(self) -> None:
        with suppress(OSError):  # a full disk takes no log either
            self._run.pause()

    def _pause(self) -> None:
        self._is_pause_wanted = True
        self._run.pause()

    def _resume(self) -> None:
        self._run.resume()
        self._is_pause_wanted = False
        self._fault = None

    async def _wait_for_change(self, request: Request) -> None:
        """Wait until the version differs from the one that the page states, for some seconds at most."""
        known = request.query_params.get("version")
        end_s = time.monotonic() + _MAX_WAIT_S
        while known == await run_in_threadpool(self._version) and time.monotonic() < end_s and not self.closing:
            if await request.is_disconnected():
                return
            await asyncio.sleep(_POLL_S)

    async def _try(self, act: Callable[[], bool | None], shown: str | None = None) -> bool | None:
        """Return what an action gives. A failure of device or disk pauses the run, and shows to the experimenter.

        `shown`: in place of the reason, for the participant.
        """
        try:
            return await run_in_threadpool(act)
        except Rejected as reason:
            raise HTTPException(422, plain(str(reason))) from reason
        except (ControllerError, OSError) as reason:  # TransportError is an OSError
            self._fault = plain(str(reason))
            await run_in_threadpool(self._rest)
            raise HTTPException(503, shown or self._fault) from reason

    def _page(self, name: str) -> Callable[[Request], Awaitable[Response]]:
        content = (_PAGES / name).read_bytes()

        async def endpoint(_request: Request) -> Response:
            return Response(content, media_type="text/html; charset=utf-8")

        return endpoint


def serve(
    run: Session,
    host: str = DEFAULT_HOST,
    port: int = DEFAULT_PORT,
    aids: Aids = Aids(),
    say: Callable[[str], None] = print,
) -> None:
    """Serve the pages until the run has ended or an exception, such as KeyboardInterrupt, ends it; the actuator rests.

    `host`: the address that is bound; "0.0.0.0" lets tablets of the same network in. `port`: 0 takes a free one.
    `say` gets a line for each address. Raises InputError if the address cannot be bound.
    """
    try:
        listening = socket.create_server((host, port), family=socket.AF_INET6 if ":" in host else socket.AF_INET)
    except (OSError, OverflowError) as reason:
        raise InputError(f"cannot serve pages at {host}, port {port}: {reason}; give another host or port") from reason
    pages = StudyPages(run, aids)
    server = uvicorn.Server(
        uvicorn.Config(
            pages.application(),
            http="h11",
            ws="none",
            lifespan="off",
            log_level="error",
            access_log=False,  # it would show the experimenter's address
            server_header=False,
            limit_concurrency=_MAX_CONNECTIONS,
            timeout_graceful_shutdown=2,
        )
    )
    stopped = threading.Event()

    def work() -> None:
        try:
            server.run(sockets=[listening])
        finally:
            stopped.set()

    # In a thread of its own, where uvicorn leaves the signals to this process.
    threading.Thread(target=work, name="study pages", daemon=True).start()
    try:
        for address in _addresses(host, listening.getsockname()[1]):
            say(f"participant: {address}/")
            say(f"experimenter: {address}/experimenter/{pages.token}")
        while not run.state().ended:
            if stopped.wait(0.1):
                raise InputError("the server of the pages has stopped; start the study again, and it goes on")
        stopped.wait(_LINGER_S)
    finally:
        pages.closing = server.should_exit = True
        with suppress(OSError):  # a full disk takes no log; the actuator rests all the same
            run.stop_playing()
        stopped.wait(5.0)
        listening.close()
        with suppress(OSError):
            run.stop_playing()  # a request that was under way may have begun to play


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


async def _read(request: Request, kind: type[_Request] | type[_Nothing]) -> Any:
    """Return the body of a request as a structure. Raises HTTPException for any other body."""
    if request.headers.get("content-type", "").partition(";")[0].strip().lower() != "application/json":
        raise HTTPException(415, "send application/json")
    body = b""
    try:
        async with asyncio.timeout(_MAX_BODY_S):
            async for chunk in request.stream():
                body += chunk
                if len(body) > _MAX_BODY_BYTES:
                    raise HTTPException(413, "the request is too long")
        return msgspec.json.decode(body, type=kind)
    except TimeoutError as reason:
        raise HTTPException(408, "the request came too slowly") from reason
    except (msgspec.DecodeError, RecursionError) as reason:  # ValidationError is a DecodeError
        raise HTTPException(400, plain(str(reason))) from reason


async def _guard(request: Request, go_on: Callable[[Request], Awaitable[Response]]) -> Response:
    """Reject what comes through a foreign name or page (DNS rebinding, forged requests); add the security headers."""
    host = request.headers.get("host", "")
    if not _is_own(host):
        response: Response = JSONResponse({"error": "foreign host; open the address that the study names"}, 421)
    elif request.headers.get("origin", f"http://{host}") != f"http://{host}":
        response = JSONResponse({"error": "a request of a foreign page"}, 403)
    else:
        response = await go_on(request)
    response.headers.update(_HEADERS)
    return response


def _is_own(host: str) -> bool:
    """Return whether a Host header names this machine: by number, as DNS cannot do, or by its own name."""
    try:
        name = urlsplit(f"//{host}").hostname or ""
        if name in ("localhost", own := socket.gethostname().lower(), f"{own}.local"):
            return True
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


async def _http_error(_request: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    return JSONResponse({"error": error.detail}, error.status_code)


async def _defect(_request: Request, _error: Exception) -> Response:
    """Answer in one line; the traceback goes to the terminal."""
    return JSONResponse({"error": CALL_THE_EXPERIMENTER}, 500)
