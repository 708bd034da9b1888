"""Takes the screenshots of a study's pages, as PNG in docs/figures: `python -m studies.study_screenshots`."""

from collections.abc import Callable
from pathlib import Path

import click
from playwright.sync_api import Browser, Error, Page, ViewportSize, sync_playwright

from studies import page
from tests.study.stub_run import StubRun, chromium, mushra, served, trial
from vibrocast.files import atomic_write
from vibrocast.study.server import Aids
from vibrocast.study.trials import Screen

FIGURES = Path(__file__).resolve().parents[1] / "docs" / "figures"
SIZE = ViewportSize(width=1024, height=640)


def _grade(shown: Page, address: str, _secret: str) -> None:
    shown.goto(address)
    shown.click("[data-label='R']")
    shown.get_by_role("button", name="Stop").click()
    shown.click("[data-label='A']")
    shown.wait_for_selector("[data-label='A'].playing")
    shown.wait_for_timeout(2000)  # a part of the texture has played


def _rate(shown: Page, address: str, _secret: str) -> None:
    shown.goto(address)
    for label, steps in (("reference", 0), ("A", 4), ("B", -3), ("C", 2)):
        shown.click(f"[data-label='{label}']")
        shown.wait_for_selector(f"[data-label='{label}'].playing")
        for _ in range(abs(steps)):
            shown.keyboard.press("PageUp" if steps > 0 else "PageDown")


def _watch(shown: Page, address: str, secret: str) -> None:
    _grade(shown.context.new_page(), address, secret)
    shown.goto(secret)
    shown.get_by_text("connected", exact=True).wait_for()


SCREENSHOTS: dict[str, tuple[Screen, Callable[[Page, str, str], None]]] = {
    "study_participant": (trial(12, "RA", total=42, question="How different is A from R?"), _grade),
    "study_mushra": (mushra(3, 6, total=9), _rate),
    "study_experimenter": (trial(12, "RA", total=42), _watch),
}


def take(browser: Browser, name: str) -> bytes:
    """Return a screenshot as PNG."""
    screen, act = SCREENSHOTS[name]
    with (
        served(StubRun([screen]), Aids(stimulus_seconds=5)) as (address, secret),
        browser.new_context(viewport=SIZE) as context,
    ):
        shown = context.new_page()
        act(shown, address, secret)
        return shown.screenshot()


@page.drawing(FIGURES)
def main(out: Path) -> None:
    """Take every screenshot."""
    with sync_playwright() as playwright:
        try:
            browser = playwright.chromium.launch(executable_path=chromium(), args=["--no-sandbox"])
        except Error as error:
            raise click.ClickException(
                f"Chromium does not start; install Debian's package chromium: {error}"
            ) from error
        out.mkdir(parents=True, exist_ok=True)
        for name in SCREENSHOTS:
            with atomic_write(out / f"{name}.png") as partial:
                partial.write_bytes(take(browser, name))
            click.echo(out / f"{name}.png")


if __name__ == "__main__":
    main()
