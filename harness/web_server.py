"""Serves pages to browsers on this machine or in its network; no client, however slow, keeps the others out."""

import contextlib
import ipaddress
import json
import select
import socket
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler
from socketserver import ThreadingTCPServer
from typing import Any
from urllib.parse import parse_qsl, urlsplit

from vibrocast.errors import InputError
from vibrocast.files import plain

MAX_BODY_BYTES = 1 << 16
MAX_CONNECTIONS, MAX_OF_ADDRESS = 64, 16
MAX_REQUEST_S, MAX_ANSWER_S = 5.0, 30.0
"""Within this time a request must have come, header and body, and an answer must have been taken."""

_HEADERS = {
    # The pages hold their own script and style, and load nothing else.
    "Content-Security-Policy": "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; "
    "connect-src 'self'; img-src data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "Cache-Control": "no-store",
    "Referrer-Policy": "no-referrer",  # an address may hold a secret
    "X-Content-Type-Options": "nosniff",
}


@dataclass(frozen=True)
class Request:
    """A request. `method`: "GET" or "POST". `body`: JSON of a POST. `is_gone`: returns whether its client has left."""

    method: str
    path: str
    query: Mapping[str, str]
    body: bytes
    is_gone: Callable[[], bool]


@dataclass(frozen=True)
class Page:
    """The answer to a request."""

    content: bytes
    kind: str = "text/html; charset=utf-8"


def json_page(content: object) -> Page:
    """Return an answer in JSON. Raises ValueError for NaN and infinity, which JSON lacks."""
    return Page(json.dumps(content, allow_nan=False).encode(), "application/json")


class Refused(Exception):
    """A request that is answered with an error. Its arguments: the status of HTTP, and a line for people."""


@contextlib.contextmanager
def web_server(
    answer: Callable[[Request], Page], host: str = "127.0.0.1", port: int = 0, failed: str = "look at the terminal"
) -> Iterator[int]:
    """Serve while the block lasts; yield the port. Raises InputError if the address cannot be bound.

    `answer` is called from any thread, and may raise Refused. `port`: 0 takes a free one. `failed`: the text of an
    answer where `answer` raises anything else, whose traceback goes to the terminal.
    """
    try:
        server = _Server(answer, host, port, failed)
    except (OSError, OverflowError) as reason:
        raise InputError(f"cannot serve pages at {host}, port {port}: {reason}; give another host or port") from reason
    threading.Thread(target=server.serve_forever, args=(0.05,), name="web server", daemon=True).start()
    try:
        yield server.server_address[1]
    finally:
        server.shutdown()
        server.server_close()


class _Server(ThreadingTCPServer):
    """A thread for each connection, which brings one request. Where they are too many, the slowest has to go."""

    allow_reuse_address = daemon_threads = True
    request_queue_size = MAX_CONNECTIONS

    def __init__(self, answer: Callable[[Request], Page], host: str, port: int, failed: str) -> None:
        self.answer, self.failed = answer, failed
        self.address_family = socket.AF_INET6 if ":" in host else socket.AF_INET
        self._lock = threading.Lock()
        self._open: dict[Any, str] = {}
        """Connections, the oldest first, and the address at their other end."""
        self._until_s: dict[Any, float] = {}
        """When the time of those is over whose request has not come in whole."""
        super().__init__((host, port), _Handler)

    def verify_request(self, request: Any, client_address: Any) -> bool:
        """Return whether to serve a new connection: in place of the oldest that still waits, where there are many."""
        with self._lock:
            same = [each for each, address in self._open.items() if address == client_address[0]]
            if len(same) >= MAX_OF_ADDRESS or len(self._open) >= MAX_CONNECTIONS:
                rivals = same if len(same) >= MAX_OF_ADDRESS else self._open
                slowest = next((each for each in rivals if each in self._until_s), None)
                if slowest is None:
                    return False
                self._give_up(slowest)
            self._open[request] = client_address[0]
            self._until_s[request] = time.monotonic() + MAX_REQUEST_S
        return True

    def service_actions(self) -> None:
        """End the requests that come too slowly."""
        with self._lock:
            for each in [each for each, until_s in self._until_s.items() if until_s < time.monotonic()]:
                self._give_up(each)

    def has_come(self, connection: Any) -> bool:
        """Note that a request has been read; return whether it was in time."""
        with self._lock:
            return self._until_s.pop(connection, None) is not None

    def shutdown_request(self, request: Any) -> None:
        """Close a connection."""
        with self._lock:
            self._open.pop(request, None)
            self._until_s.pop(request, None)
        super().shutdown_request(request)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Say nothing of a client that has left, or takes nothing."""

    def _give_up(self, connection: Any) -> None:
        del self._until_s[connection]
        with contextlib.suppress(OSError):
            connection.shutdown(socket.SHUT_RD)  # its thread reads the end


class _Handler(BaseHTTPRequestHandler):
    server: _Server
    timeout = MAX_ANSWER_S

    def do_GET(self) -> None:
        try:
            page = self.server.answer(self._request())
        except Refused as reason:
            self.send_error(*reason.args)
        except (ConnectionError, TimeoutError):
            raise
        except Exception:
            traceback.print_exc()
            self.send_error(500, self.server.failed)
        else:
            self._send(200, page)

    do_POST = do_GET

    def _request(self) -> Request:
        """Read the rest of a request, and check it. Raises Refused."""
        stated = self.headers.get("Content-Length", "0")
        length = int(stated) if stated.isascii() and stated.isdecimal() and len(stated) < 10 else 0
        body = self.rfile.read(min(length, 2 * MAX_BODY_BYTES))  # of a longer one, its client may miss the answer
        if not self.server.has_come(self.connection):
            raise Refused(408, "the request came too slowly")
        # A foreign page may send requests, or reach this machine under a name of its own (DNS rebinding).
        host = self.headers.get("Host", "")
        if not _is_own(host):
            raise Refused(421, "foreign host; open the address that the command prints")
        if self.headers.get("Origin", f"http://{host}") != f"http://{host}":
            raise Refused(403, "a request of a foreign page")
        if length > MAX_BODY_BYTES:
            raise Refused(413, "the request is too long")
        if self.command == "POST" and self.headers.get_content_type() != "application/json":
            raise Refused(415, "send application/json")
        path, _, query = self.path.partition("?")
        return Request(self.command, path, dict(parse_qsl(query)), body, self._is_gone)

    def _is_gone(self) -> bool:
        return bool(select.select([self.connection], [], [], 0)[0]) and not self.connection.recv(1, socket.MSG_PEEK)

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        """Answer with the one page of errors, also for what `http.server` rejects."""
        self._send(code, json_page({"error": plain(message or self.responses[HTTPStatus(code)][0])}))

    def _send(self, status: int, page: Page) -> None:
        self.send_response_only(status)
        for name, value in {**_HEADERS, "Content-Type": page.kind, "Content-Length": str(len(page.content))}.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(page.content)

    def log_message(self, format: str, *arguments: Any) -> None:
        """Say nothing: the terminal is for the command, and a path may hold a secret."""


def _is_own(host: str) -> bool:
    """Return whether a Host header names this machine: by number, as DNS cannot do, or by its own name."""
    with contextlib.suppress(ValueError):
        name, own = urlsplit(f"//{host}").hostname or "", socket.gethostname().lower()
        return name in ("localhost", own, f"{own}.local") or bool(ipaddress.ip_address(name))
    return False
