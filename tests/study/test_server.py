"""The server of a study's pages: what it shows to whom, and requests that do not fit or are hostile."""

import json
import threading
import time
import weakref
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from functools import partialmethod
from typing import Any

import httpx
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.study.stub_run import CONDITIONS, LOST, WELCOME, StubRun, mushra, served, trial
from vibrocast.errors import InputError
from vibrocast.harness.web_server import web_server
from vibrocast.study.server import CALL_THE_EXPERIMENTER, NOISE_RATE_HZ, Aids, StudyPages, serve
from vibrocast.study.session import Session
from vibrocast.study.trials import Break, Question, Screen

pytestmark = pytest.mark.usefixtures("no_lingering")
SCREENS: tuple[Screen, ...] = (WELCOME, Question("age", "Your age?"), trial(1), Break(60.0, 1, 3), mushra(2))


class Client:
    """A browser, and a server for it alone; it knows the screen which it shows."""

    def __init__(self, run: Session, aids: Aids | None = None) -> None:
        self.pages = StudyPages(run, aids or Aids())
        server = ExitStack()
        port = server.enter_context(web_server(self.pages.answer, failed=CALL_THE_EXPERIMENTER))
        self.address = f"http://127.0.0.1:{port}"
        weakref.finalize(self, server.close)

    def request(self, method: str, url: str, **content: Any) -> httpx.Response:
        return httpx.request(method, self.address + url, trust_env=False, **content)

    get = partialmethod(request, "GET")
    post = partialmethod(request, "POST")

    def screen(self) -> dict[str, Any]:
        shown: dict[str, Any] = self.get("/api/screen").json()
        return shown

    def act(self, action: str, **content: object) -> httpx.Response:
        return self.request("POST", f"/api/{action}", json={"screen": self.screen()["screen"]["id"]} | content)

    def secret(self, path: str = "") -> str:
        return f"/experimenter/{self.pages.token}{path}"


def error(response: httpx.Response) -> str:
    assert set(response.json()) == {"error"}
    text: str = response.json()["error"]
    assert text and "\n" not in text
    return text


@pytest.mark.parametrize(("spectrum", "db_per_octave"), [("white", 0.0), ("pink", -3.0103)])
def test_masking_noise_has_the_slope_of_its_name_and_no_seam(spectrum: str, db_per_octave: float) -> None:
    assert Client(StubRun(SCREENS)).get("/api/noise").status_code == 404
    client = Client(StubRun(SCREENS), Aids(masking_noise_dbfs=-30.0, masking_noise_spectrum=spectrum))
    samples = np.frombuffer(client.get("/api/noise").content, "<f4").astype(float)
    assert np.sqrt(np.mean(samples**2)) == pytest.approx(1, abs=1e-3)
    assert np.max(np.abs(samples)) < 10 ** (16 / 20)
    assert abs(samples[0] - samples[-1]) < 5 * np.std(np.diff(samples))
    power = np.abs(np.fft.rfft(samples)) ** 2
    hz = np.arange(len(power)) * NOISE_RATE_HZ / len(samples)
    levels_db = [10 * np.log10(np.mean(power[(hz >= low) & (hz < 2 * low)])) for low in (31.25 * 2.0 ** np.arange(9))]
    assert np.diff(levels_db) == pytest.approx(db_per_octave, abs=0.05)


def test_a_participant_walks_through_a_run() -> None:
    run = StubRun(SCREENS)
    client = Client(run)
    assert client.screen()["screen"]["title"] == "Welcome"
    assert client.act("go_on").status_code == 200
    assert client.act("reply", text="30\x1b[2J").status_code == 200
    assert run.replies == ["30\\x1b[2J"]
    assert client.act("play", label="A").status_code == 200
    assert client.screen()["playing"] == "A"
    assert client.screen()["plays"] == {"A": 1}
    assert error(client.act("answer", values=[1])) == "feel every texture first"
    assert error(client.act("play", label="B")) == "an interval is playing; wait for its end"
    client.act("stop")
    client.act("play", label="B")
    assert client.act("answer", values=[1]).json() == {"correct": None}
    assert client.screen()["screen"]["seconds"] == 60
    client.act("go_on")
    for label in ("reference", *"ABCDE"):
        client.act("play", label=label)
    client.act("answer", values=[1, 2, 3, 4, 5])
    assert run.answers == [(1,), (1, 2, 3, 4, 5)]
    assert client.screen()["ended"]


def test_pages_load_nothing_from_elsewhere_and_the_experimenters_page_is_found_by_its_token_alone() -> None:
    client = Client(StubRun([trial(1)]))
    for path in ("/", client.secret()):
        page = client.get(path)
        assert page.headers["content-security-policy"].startswith("default-src 'none'")
        assert page.headers["cache-control"] == "no-store"
        assert not [word for word in ("http:", "https:", "src=", "@import", "url(") if word in page.text]
    for path in ("/experimenter", "/experimenter/", "/experimenter/x", "/experimenter/%C3%A4/state"):
        assert client.get(path).status_code == 404
    assert client.post("/experimenter/x/abort", json={}).status_code == 404
    assert client.pages.token not in client.get("/").text + client.get("/api/screen").text


def test_the_participant_never_sees_a_condition() -> None:
    client = Client(StubRun(SCREENS))
    texts = [client.get("/").text]
    for _ in SCREENS:
        texts.append(client.get("/api/screen").text)
        for label in client.screen()["screen"].get("labels", ["none"]):
            texts.append(client.act("play", label=label).text)
            texts.append(client.get("/api/screen").text)
            texts.append(client.act("stop").text)
        texts.append(client.get(client.secret("/state")).text)
        for action, content in (
            ("go_on", {}),
            ("reply", {"text": "30"}),
            ("answer", {"values": [1]}),
            ("answer", {"values": [1, 2, 3, 4, 5]}),
        ):
            texts.append(client.act(action, **content).text)
    assert client.screen()["ended"]
    assert any('"plays": {"A": 1' in text for text in texts)
    assert [word for word in (*CONDITIONS, "wood/", "facts", '"stimulus"') for text in texts if word in text] == []


class SlowRun(StubRun):
    """A run in which others may come between the look at a screen and the act that follows."""

    def screen(self) -> Screen:
        screen = super().screen()
        time.sleep(0.02)
        return screen


def test_an_answer_counts_once_even_from_presses_at_the_same_time() -> None:
    run = SlowRun([trial(1), trial(2)])
    client = Client(run)
    first = client.screen()["screen"]["id"]
    for label in "AB":
        client.act("play", label=label)
        client.act("stop")
    body = {"screen": first, "values": [2]}
    with ThreadPoolExecutor(6) as threads:
        codes = list(threads.map(lambda _: client.post("/api/answer", json=body).status_code, range(6)))
    assert sorted(codes) == [200, *[409] * 5]
    assert error(client.post("/api/answer", json=body)) == "this screen has passed"
    assert run.answers == [(2,)]
    assert client.post("/api/play", json={"screen": first, "label": "A"}).status_code == 409


@pytest.mark.parametrize("loss", [LOST, OSError(28, "No space left on device")], ids=["device", "disk"])
def test_a_failure_reaches_the_experimenter_alone(loss: Exception) -> None:
    run = StubRun([trial(1)])
    client = Client(run)
    run.fails = loss
    failed = client.act("play", label="A")
    if loss is not LOST:  # which the run notices by itself
        assert (failed.status_code, error(failed)) == (503, CALL_THE_EXPERIMENTER)
    assert client.screen()["screen"]["text"] == CALL_THE_EXPERIMENTER
    assert client.get(client.secret("/state")).json()["fault"] == str(loss)
    assert client.post(client.secret("/resume"), json={}).status_code == 200
    assert client.get(client.secret("/state")).json()["fault"] is None
    assert client.act("play", label="A").status_code == 200
    client.act("stop")
    run.fails = ZeroDivisionError("secret")
    assert error(client.act("play", label="A")) == CALL_THE_EXPERIMENTER


def test_the_experimenter_has_the_run_in_hand() -> None:
    run = StubRun([trial(1)])
    client = Client(run)
    assert "Abort the run" in client.get(client.secret()).text
    client.act("play", label="A")
    state = client.get(client.secret("/state")).json()
    assert (state["participant"], state["now_playing"], state["level_db"]) == (7, "A", 23.4)
    assert 0 <= state["page_seen_s"] < 60
    assert client.post(client.secret("/pause"), json={}).status_code == 200
    assert run.actuator == ["A", "rest"]
    assert client.screen()["screen"]["text"] == "Please wait."
    assert client.get(client.secret("/state")).json()["fault"] is None
    assert client.act("play", label="A").status_code == 422
    client.post(client.secret("/resume"), json={})
    twice = client.post(client.secret("/resume"), json={})
    assert (twice.status_code, error(twice)) == (422, "the run is not paused")
    client.act("play", label="A")
    client.post(client.secret("/abort"), json={})
    assert run.actuator[-1] == "rest"
    assert client.screen()["ended"]


@pytest.mark.parametrize(
    "body",
    [
        b"",
        b"{",
        b"\xff\xfe",
        b"[" * 60_000,
        b'{"screen": ' + b"[" * 30_000,
        b'{"screen": "x", "label": "A", "more": 1}',
        b'{"screen": "x", "label": 1}',
    ],
)
def test_bodies_that_fit_no_request(body: bytes) -> None:
    run = StubRun([trial(1)])
    response = Client(run).post("/api/play", content=body, headers={"Content-Type": "application/json"})
    assert response.status_code == 400
    error(response)
    assert run.actuator == []


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
    max_leaves=8,
)


@given(
    action=st.sampled_from(["play", "stop", "answer", "go_on", "reply", "pause"]),
    given_body=st.binary() | st.dictionaries(st.sampled_from(["screen", "label", "values", "text"]), JSON) | JSON,
    known=st.booleans(),
)
def test_no_body_breaks_the_server(action: str, given_body: object, known: bool) -> None:
    run = StubRun([trial(1)])
    client = Client(run)
    if known and isinstance(given_body, dict):
        given_body |= {"screen": client.screen()["screen"]["id"]}
    body = given_body if isinstance(given_body, bytes) else json.dumps(given_body).encode()
    response = client.post(f"/api/{action}", content=body, headers={"Content-Type": "application/json"})
    assert response.status_code in (200, 400, 404, 409, 422)
    if response.status_code != 200:
        error(response)
    assert run.answers == []
    assert set(run.actuator) <= {"A", "B", "rest"}


def test_a_change_ends_the_wait_of_a_page_and_another_process_has_another_version() -> None:
    run = StubRun([trial(1)])
    client = Client(run)
    version = client.screen()["version"]
    threading.Timer(0.1, run.pause).start()
    changed = client.get("/api/screen", params={"version": version}).json()
    assert changed["screen"]["type"] == "paused"
    assert len({version, changed["version"], Client(StubRun([trial(1)])).screen()["version"]}) == 3


def test_serving_ends_with_the_run_the_actuator_rests_and_an_address_in_use_is_an_error() -> None:
    run = StubRun([trial(1)])
    with served(run) as (participant, experimenter), httpx.Client(base_url=participant) as client:
        screen = client.get("/api/screen").json()["screen"]["id"]
        assert client.post("/api/play", json={"screen": screen, "label": "A"}).status_code == 200
        assert client.get(experimenter).status_code == 200
        port = int(participant.rstrip("/").rsplit(":", 1)[1])
        with pytest.raises(InputError, match=f"cannot serve pages at 127.0.0.1, port {port}"):
            serve(StubRun([trial(1)]), port=port)
        run.actuator.clear()
    assert run.actuator[-2:] == ["rest", "rest"]
    with pytest.raises(InputError, match="give another host or port"):
        serve(StubRun([trial(1)]), host="no.such.host.invalid", port=0)
