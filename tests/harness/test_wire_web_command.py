"""`monitor --web` in a real Chromium: the page shows what passes, says what is wrong, and changes nothing."""

import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import closing, contextmanager

import pytest
from playwright.sync_api import Browser, expect

from tests.command import OAK, run
from tests.harness.test_wire_command import needs_terminals, serving

pytestmark = [needs_terminals, pytest.mark.slow]


@contextmanager
def watched(device: str = "sim") -> Iterator[tuple[str, str]]:
    """Run `monitor --web`; yield the addresses of its page and of its port."""
    with serving("monitor", device, "--web") as (page, process):
        assert process.stderr is not None
        yield page.removeprefix("page: "), process.stderr.readline().strip()


def test_the_page_shows_signals_spectra_buffer_counters_and_state(browser: Browser) -> None:
    with watched() as (page_address, device), closing(browser.new_page()) as page:
        problems: list[str] = []
        page.on("pageerror", lambda error: problems.append(str(error)))
        page.on("console", lambda message: problems.append(message.text) if message.type == "error" else None)
        page.goto(page_address)
        expect(page.locator("#controller")).to_have_text("No controller yet")
        assert run("play", OAK, "--device", device).exit_code == 0
        expect(page.locator("#state")).to_have_text("finished")
        expect(page.locator("#controller")).to_contain_text("simulated")
        expect(page.locator("#codec")).to_have_text("codec mdct")
        for chart, curves in (("wave", 2), ("spectra", 3), ("buffer", 1)):
            expect(page.locator(f"#{chart} polyline")).to_have_count(curves)
            points = page.locator(f"#{chart} polyline").first.get_attribute("points")
            assert points is not None and len(points.split()) > 5
        expect(page.locator("#hints")).to_have_text("Nothing unusual.")
        expect(page.locator("#counters")).to_contain_text("samples decoded wrongly0")
        assert not problems


def test_the_page_is_for_this_machine_and_changes_nothing() -> None:
    with watched() as (page_address, _):
        for path, host, status in (("", "evil.example", 421), ("state", "evil.example", 421), ("other", "", 404)):
            request = urllib.request.Request(page_address + path, headers={"Host": host} if host else {})
            with pytest.raises(urllib.error.HTTPError) as error:
                urllib.request.urlopen(request, timeout=5)
            assert error.value.code == status
        with pytest.raises(urllib.error.HTTPError) as refused:
            urllib.request.urlopen(page_address, data=b"stop", timeout=5)
        assert refused.value.code == 415
