"""Serves one read-only page on the traffic of a wire, to this machine alone."""

import contextlib
import json
import threading
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from vibrocast.errors import InputError

PAGE = Path(__file__).with_name("wire_page.html")
ADDRESS = "127.0.0.1"
_HEADERS = {
    "Cache-Control": "no-store",
    "Content-Security-Policy": "default-src 'self'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; "
    "img-src data:; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
}


@contextlib.contextmanager
def wire_page(document: Callable[[], dict[str, Any]], port: int = 0) -> Iterator[str]:
    """Serve the page while the block lasts; yield its address. `document`: the content, from any thread.

    `port`: 0 = a free one. Raises InputError where it is taken.
    """

    class Handler(BaseHTTPRequestHandler):
        """Answers with the page, and with its content as JSON."""

        def do_GET(self) -> None:
            # A foreign page may reach this machine under a name of its own (DNS rebinding), so names are rejected.
            if urlsplit(f"//{self.headers.get('Host', '')}").hostname not in (ADDRESS, "localhost"):
                self._answer(421, "text/plain", b"foreign host; open the address that the command prints")
            elif self.path == "/":
                self._answer(200, "text/html; charset=utf-8", PAGE.read_bytes())
            elif self.path == "/state":
                self._answer(200, "application/json", json.dumps(document(), allow_nan=False).encode())
            else:
                self._answer(404, "text/plain", b"no such page; open /")

        def _answer(self, status: int, kind: str, body: bytes) -> None:
            self.send_response(status)
            for name, value in {**_HEADERS, "Content-Type": kind, "Content-Length": str(len(body))}.items():
                self.send_header(name, value)
            self.end_headers()
            with contextlib.suppress(ConnectionError):
                self.wfile.write(body)

        def log_message(self, format: str, *arguments: Any) -> None:
            """Say nothing: standard error is for the command."""

    try:
        server = ThreadingHTTPServer((ADDRESS, port), Handler)
    except OSError as error:
        raise InputError(
            f"no page can be served at port {port}",
            str(error.strerror),
            "choose another `port`, or 0 for a free one",
            parameter="port",
        ) from error
    server.daemon_threads = True
    thread = threading.Thread(target=server.serve_forever, name="wire page", daemon=True)
    thread.start()
    try:
        yield f"http://{ADDRESS}:{server.server_port}/"
    finally:
        server.shutdown()
        server.server_close()
