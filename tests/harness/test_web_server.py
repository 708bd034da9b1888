"""The server of pages: requests that are foreign, too long or too slow, and the error page of them all."""

import socket
import time
from collections.abc import Iterator
from contextlib import suppress
from typing import Any

import httpx
import pytest

from vibrocast.harness import web_server
from vibrocast.harness.web_server import MAX_CONNECTIONS, MAX_OF_ADDRESS, Page, Refused, Request


def answer(request: Request) -> Page:
    match request.path:
        case "/":
            return Page(b"page")
        case "/waits":
            while not request.is_gone():
                time.sleep(0.01)
        case "/defect":
            raise ZeroDivisionError("secret")
    raise Refused(404, "no such\npage")


@pytest.fixture
def port() -> Iterator[int]:
    with web_server.web_server(answer) as port:
        yield port


def asked(port: int, path: str = "/", method: str = "GET", **content: Any) -> httpx.Response:
    url = f"http://127.0.0.1:{port}{path}"
    return httpx.request(method, url, trust_env=False, **content)


def exchanged(port: int, request: bytes) -> str:
    with socket.create_connection(("127.0.0.1", port), timeout=10) as connection:
        connection.sendall(request)
        return connection.makefile("rb").read().decode()


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({"Host": "evil.example"}, 421),
        ({"Host": "localhost.evil.example:8017"}, 421),
        ({"Host": "["}, 421),
        ({"Host": "[::1"}, 421),
        ({"Host": ""}, 421),
        ({"Origin": "http://evil.example"}, 403),
        ({"Origin": "http://127.0.0.1:9999"}, 403),
        ({"Origin": "null"}, 403),
        ({"Host": "localhost:8017"}, 200),
        ({"Host": "192.168.1.20:8017", "Origin": "http://192.168.1.20:8017"}, 200),
        ({"Host": "[fe80::1]:8017"}, 200),
    ],
)
def test_foreign_names_and_pages_are_rejected(port: int, headers: dict[str, str], status: int) -> None:
    response = asked(port, headers=headers)
    assert response.status_code == status
    assert response.headers["x-content-type-options"] == "nosniff"
    assert status == 200 or set(response.json()) == {"error"}


@pytest.mark.parametrize(
    ("content", "status"),
    [
        ({"content": b"{}", "headers": {"Content-Type": "text/plain"}}, 415),
        ({"data": {"label": "A"}}, 415),
        ({"json": "A" * (web_server.MAX_BODY_BYTES + 1)}, 413),
        ({"json": {}}, 200),
    ],
)
def test_a_body_is_json_and_short(port: int, content: dict[str, Any], status: int) -> None:
    assert asked(port, method="POST", **content).status_code == status


def test_every_error_is_the_same_page_and_only_a_defect_is_told_in_the_terminal(
    port: int, capsys: pytest.CaptureFixture[str]
) -> None:
    assert asked(port, "/other").json() == {"error": "no such\\npage"}
    assert asked(port, method="PUT").status_code == 501
    assert '{"error":' in exchanged(port, b"GET / HTTP/9.9\r\n\r\n")
    assert '{"error":' in exchanged(port, b"\x16\x03\x01 tls\r\n")
    assert capsys.readouterr().err == ""
    assert asked(port, "/defect").json() == {"error": "look at the terminal"}
    assert "ZeroDivisionError: secret" in capsys.readouterr().err


@pytest.mark.parametrize(
    "part", [b"", b"GET / HT", b"GET / HTTP/1.1\r\nHo", b"POST / HTTP/1.1\r\nContent-Length: 9\r\n\r\n{"]
)
def test_half_a_request_keeps_nobody_out(port: int, part: bytes) -> None:
    half = [socket.create_connection(("127.0.0.1", port), timeout=10) for _ in range(MAX_CONNECTIONS + 16)]
    for connection in half:
        connection.sendall(part)
    assert asked(port).content == b"page"
    for connection in half:
        connection.close()


@pytest.mark.parametrize("part", [b"GET / HTTP/1.1\r\nHo", b"POST / HTTP/1.1\r\nContent-Length: 9\r\n\r\n{"])
def test_a_request_that_comes_too_slowly_is_ended(monkeypatch: pytest.MonkeyPatch, port: int, part: bytes) -> None:
    monkeypatch.setattr(web_server, "MAX_REQUEST_S", 1.0)
    assert "the request came too slowly" in exchanged(port, part)


def test_one_address_gets_a_part_of_the_connections(port: int) -> None:
    waiting = [socket.create_connection(("127.0.0.1", port), timeout=10) for _ in range(MAX_OF_ADDRESS)]
    for connection in waiting:
        connection.sendall(b"GET /waits HTTP/1.1\r\nHost: localhost\r\n\r\n")
    with pytest.raises(httpx.TransportError):
        while True:  # until all of them have come
            assert asked(port).content == b"page"
    for connection in waiting:
        connection.close()
    while True:
        with suppress(httpx.TransportError):  # until one of them has gone
            assert asked(port).content == b"page"
            break
