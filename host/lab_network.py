"""Joins a player to a laboratory's network: OSC messages control it, LSL markers tell when a texture is felt."""

import contextlib
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from vibrocast import extras
from vibrocast.errors import InputError
from vibrocast.host.devices import Session
from vibrocast.host.track_player import BackgroundPlayer, Command, Event, TrackOptions, tracks_of

TIMEOUT_S = 30.0
"""A client that sends nothing for so long has gone; what it plays stops."""
_POLL_S = 0.05
_MAX_LOOPS = 65_535


class Markers:
    """A stream of the Lab Streaming Layer, with a marker at the time at which something is felt.

    The markers are "start NAME", "loop NAME", "pause NAME", "resume NAME" and "stop NAME".
    """

    def __init__(self, source: str) -> None:
        """Offer the stream `vibrocast` of type Markers; `source`: what an inlet finds again after an interruption.

        Raises MissingExtraError without the extra [lab].
        """
        extras.require("lab", "pylsl")
        import pylsl

        self._clock = pylsl.local_clock
        info = pylsl.StreamInfo("vibrocast", "Markers", 1, pylsl.IRREGULAR_RATE, pylsl.cf_string, source)
        self._outlet = pylsl.StreamOutlet(info)

    def tell(self, event: Event) -> None:
        """Send the marker of an event, if it has one."""
        words = {"track": "start", "pass": "loop", "paused": "pause", "resumed": "resume", "ended": "stop"}
        if (word := words.get(event.kind)) is None:
            return
        felt_s = event.skin_s - (event.position_s if event.kind in ("track", "pass") else 0.0)
        self._outlet.push_sample([f"{word} {event.track}"], self._clock() + felt_s - time.time())


class OscServer:
    """Plays the files of a folder on a controller as OSC messages say (Open Sound Control 1.0, over UDP).

    `/play NAME` plays a file, by its path in the folder, with or without suffix; `/play NAME LOOPS` plays it so often,
    0 without end. `/gain_db DB` sets the level of this track and all that follow. `/pause`, `/resume` and `/stop` do as
    they say. Any message counts as a sign of life, `/alive` does nothing else. The client gets `/track NAME`,
    `/ended NAME` and `/error TEXT`.
    """

    def __init__(
        self,
        session: Session,
        folder: Path,
        address: tuple[str, int],
        options: TrackOptions,
        *,
        timeout_s: float = TIMEOUT_S,
        tell: Callable[[Event], None] | None = None,
    ) -> None:
        """Listen at `address`, host and port; `options`: of each track; `tell`: called with each Event of a player.

        `timeout_s`: as TIMEOUT_S; 0 = wait for ever. Raises InputError for a folder without a track, and where nothing
        can listen; MissingExtraError without the extra [lab].
        """
        extras.require("lab", "pythonosc")
        from pythonosc.dispatcher import Dispatcher
        from pythonosc.osc_server import BlockingOSCUDPServer

        self._session, self._options, self._timeout_s = session, options, timeout_s
        self._tell = tell
        self._files = files_by_name(folder)
        self._gain_db = 0.0
        self._player: BackgroundPlayer | None = None
        self._client: tuple[str, int] | None = None
        self._heard_s = time.monotonic()
        self._failure: Exception | None = None
        dispatcher = Dispatcher()
        dispatcher.set_default_handler(self._received, needs_reply_address=True)
        try:
            self._server = BlockingOSCUDPServer(address, dispatcher, timeout=_POLL_S)
        except (OSError, OverflowError) as error:
            host, port = address
            raise InputError(f"{host}:{port}: no OSC server can listen there: {error}; give another port") from error

    @property
    def port(self) -> int:
        """The port at which it listens."""
        return int(self._server.server_address[1])

    def serve(self, until: Callable[[], bool] = lambda: False) -> None:
        """Serve until `until` returns True. Raises what ended a player, once the controller has failed."""
        with self._server, contextlib.ExitStack() as stack:
            stack.callback(self._stop)
            while not until():
                self._server.handle_request()
                if self._failure is not None:
                    raise self._failure
                if self._player is not None and self._player.has_ended:
                    self._stop()
                if self._timeout_s and self._player and time.monotonic() - self._heard_s > self._timeout_s:
                    self._stop()
                    self._send("/error", f"no message for {self._timeout_s:g} s, so the output rests; send /alive")

    def _received(self, client: tuple[str, int], address: str, *values: Any) -> None:
        """Do what a message says; tell its client why it cannot be done."""
        self._client, self._heard_s = client, time.monotonic()
        try:
            self._do(address, values)
        except InputError as error:
            self._send("/error", str(error))
        except Exception as error:  # `serve` raises it; the library would print it and go on
            self._failure = error

    def _do(self, address: str, values: tuple[Any, ...]) -> None:
        """Do what a message says. Raises InputError."""
        match address, values:
            case "/play", (str(name), *loops):
                self._play(name, _loops(loops))
            case "/gain_db", (int() | float() as gain_db,) if abs(gain_db) < float("inf"):
                self._gain_db = float(gain_db)
                if self._player is not None:
                    self._player.remote.send(Command("gain", self._gain_db - self._player.player.gain_db))
            case (("/pause" | "/resume"), ()):
                if self._player is not None:
                    self._player.remote.send(Command(address[1:]))
            case "/stop", ():
                self._stop()
            case "/alive", _:
                pass
            case _:
                raise InputError(
                    f"{address[:40]} with {len(values)} values is no message; send /play NAME [LOOPS], /gain_db DB, "
                    "/pause, /resume, /stop or /alive"
                )

    def _play(self, name: str, loops: int) -> None:
        """Play a file instead of what plays. Raises InputError for a name that is not in the folder."""
        if name not in self._files:
            raise InputError(f"{name[:80]!r} is not in the folder; it holds {', '.join(list(self._files)[:20])}")
        self._stop()
        options = replace(self._options, loops=loops)
        self._player = BackgroundPlayer(self._session, [self._files[name]], options, self._told)
        self._player.remote.send(Command("gain", self._gain_db))

    def _told(self, event: Event) -> None:
        """Pass an event of a player on, in its thread."""
        if self._tell is not None:
            self._tell(event)
        if event.kind in ("track", "ended"):
            self._send(f"/{event.kind}", event.track)
        elif event.kind == "failed":
            self._send("/error", str(event.error))

    def _stop(self) -> None:
        """Bring the output to rest. Raises what ended the player."""
        playing, self._player = self._player, None
        if playing is not None:
            playing.remote.send(Command("stop"))
            playing.wait()

    def _send(self, address: str, text: str) -> None:
        from pythonosc.osc_message_builder import build_msg

        if self._client is not None:
            with contextlib.suppress(OSError):  # the client has gone
                self._server.socket.sendto(build_msg(address, [text]).dgram, self._client)


def files_by_name(folder: Path) -> Mapping[str, Path]:
    """Return the tracks of a folder by their paths in it, also without suffix where that names one.

    Raises InputError for a folder that is none, and as `tracks_of`.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: not a folder; give one with recordings or .vct files")
    tracks = [track.relative_to(folder) for track in tracks_of([folder])]
    short = [track.with_suffix("").as_posix() for track in tracks]
    named = {name: folder / track for name, track in zip(short, tracks, strict=True) if short.count(name) == 1}
    return named | {track.as_posix(): folder / track for track in tracks}


def _loops(values: list[Any]) -> int:
    """Return how often to play. Raises InputError."""
    match values:
        case []:
            return 1
        case [int(loops)] if 0 <= loops <= _MAX_LOOPS:
            return loops
    raise InputError(f"LOOPS is a whole number from 0 to {_MAX_LOOPS}; 0 plays without end")
