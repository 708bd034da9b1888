"""The study's pages in a real Chromium: whole runs by mouse, keyboard and touch, without scrolling, and mishaps."""

import json
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, expect

from tests.study.stub_run import CONDITIONS, GRADES, LOST, WELCOME, StubRun, mushra, served, trial
from vibrocast.study.server import CALL_THE_EXPERIMENTER, Aids
from vibrocast.study.trials import Break, Choices, Message, Question, Screen, Trial

pytestmark = pytest.mark.usefixtures("no_lingering")
SIZES = ((1024, 768), (768, 1024), (1280, 800))

GRADING = trial(1, "RA", question="How different is A from R?")
SAME_DIFFERENT = trial(
    2,
    "12",
    question="Were the two textures the same?",
    response=Choices(("same", "different")),
    in_order=True,
    pause_s=0.05,
    max_plays=1,
    feedback=True,
    phase="practice",
)
ABX = trial(
    3, "ABX", question="Is X the same as A or B?", response=Choices(("A", "B")), max_plays=2, switches=True, total=None
)
PAIR = trial(4, "AB", question="Which one is rougher?", response=Choices(("A", "B", "no difference")), max_seconds=60.0)
MUSHRA = mushra(5, 10, in_order=True, pause_s=0.0)

LONG = Message("instructions", "How <b>it</b> works", "Press a button and move your finger over the plate. " * 25)
SCREENS: tuple[Screen, ...] = (
    WELCOME,
    LONG,
    Question("hand", "Which hand do you use?", ("left", "right", "both")),
    Question("age", "How old are you?"),
    GRADING,
    SAME_DIFFERENT,
    Break(0.2, 2, 3),
    ABX,
    PAIR,
    MUSHRA,
    Question("remarks", "Do you have any remarks?"),
)


ANSWERS = "[data-choice], [data-slider]"


@contextmanager
def opened(browser: Browser, address: str, size: tuple[int, int] = SIZES[0], touch: bool = False) -> Iterator[Page]:
    """Open a page; no script in it may fail."""
    context = browser.new_context(viewport={"width": size[0], "height": size[1]}, has_touch=touch, is_mobile=touch)
    context.set_default_timeout(20_000)
    page = context.new_page()
    failures: list[str] = []
    page.on("pageerror", lambda failure: failures.append(str(failure)))
    page.goto(address)
    try:
        yield page
    finally:
        context.close()
    assert failures == []


def assert_fits(page: Page) -> None:
    """Everything is in view: the page does not scroll, and no button is cut off or smaller than a finger."""
    assert page.evaluate("document.scrollingElement.scrollHeight <= innerHeight")
    assert page.evaluate("document.scrollingElement.scrollWidth <= innerWidth")
    outside = page.evaluate(
        """() => [...document.querySelectorAll("main *:not(.bar):not(kbd), footer *")].filter((each) => {
            if (!each.checkVisibility()) return false;
            const box = each.getBoundingClientRect();
            const small = each.matches("button, input") && (box.width < 63.5 || box.height < 63.5);
            const cut = each.scrollWidth > each.clientWidth + 1 || each.scrollHeight > each.clientHeight + 1;
            return small || (cut && each.matches("button, .words span")) || box.left < -0.5 || box.top < -0.5
                || box.right > innerWidth + 0.5 || box.bottom > innerHeight + 0.5;
        }).map((each) => each.outerHTML.slice(0, 100))"""
    )
    assert outside == []
    unnamed = page.locator("button, input").evaluate_all(
        """all => all.filter((each) =>
            !each.textContent && !each.ariaLabel && !each.getAttribute("aria-labelledby")).length"""
    )
    assert unnamed == 0


def wait_for_screen(page: Page, screen: Screen) -> None:
    title = screen.title if isinstance(screen, Message) else "Take a break"
    if isinstance(screen, Trial):
        title = screen.question
    elif isinstance(screen, Question):
        title = screen.text
    expect(page.get_by_role("heading", name=title, exact=True)).to_be_visible()


def press_through(page: Page, screen: Screen, press: Callable[[str], None]) -> None:
    """Do one screen by presses on elements, which `press` makes by their selectors."""
    wait_for_screen(page, screen)
    assert_fits(page)
    if isinstance(screen, Message | Break):
        press("button.main")
    elif isinstance(screen, Question) and screen.options:
        press("[data-choice='1']")
    elif isinstance(screen, Question):
        page.fill("input", "thirty")
        press("button.main")
    elif isinstance(screen, Trial):
        labels = [interval.label for interval in screen.intervals]
        if screen.in_order:
            press("button.play")
            assert_fits(page)
            expect(page.locator(ANSWERS).last).to_be_enabled()
        if not screen.in_order or screen.switches:
            for label in labels:
                press(f"[data-label='{label}']")
                expect(page.locator(f"[data-label='{label}']")).to_have_class(re.compile("playing"))
                assert_fits(page)
                press("button:has-text('Stop')")
        if isinstance(screen.response, Choices):
            press("[data-choice='1']")
        else:
            for label in screen.response.labels:
                press(f"[data-slider='{label}']")
            press("button.main")


EXPECTED = [(1,), (1,), (1,), (1,), (50,) * 10]


@pytest.mark.parametrize(
    ("size", "touch"), [(SIZES[0], False), (SIZES[2], False), (SIZES[0], True), (SIZES[1], True)], ids=str
)
def test_a_participant_answers_by_pressing(browser: Browser, size: tuple[int, int], touch: bool) -> None:
    run = StubRun(SCREENS)
    with served(run) as (address, _), opened(browser, address, size, touch) as page:
        for screen in SCREENS:
            press_through(page, screen, page.tap if touch else page.click)
        expect(page.get_by_role("heading", name="Thank you")).to_be_visible()
        assert_fits(page)
    assert [answer if len(answer) == 1 else (50,) * 10 for answer in run.answers] == EXPECTED
    assert all(45 <= value <= 55 for value in run.answers[-1])
    assert run.replies == ["right", "thirty", "thirty"]


def test_a_participant_answers_by_keyboard(browser: Browser) -> None:
    run = StubRun(SCREENS)
    with served(run) as (address, _), opened(browser, address) as page:
        keys = page.keyboard
        for screen in SCREENS:
            wait_for_screen(page, screen)
            assert_fits(page)
            match screen:
                case Message():
                    keys.press("Enter")
                case Break():
                    expect(page.get_by_role("button", name="Continue")).to_be_enabled()
                    keys.press("Enter")
                case Question() if screen.options:
                    keys.press("2")
                case Question():
                    keys.type("a 1 b")
                    keys.press("Enter")
                case Trial() if isinstance(screen.response, Choices):
                    keys.press("2")  # nothing has been felt yet
                    play_by_keys(page, screen)
                    keys.press("2")
                case Trial():
                    rate_by_keys(page, screen)
        expect(page.get_by_role("heading", name="Thank you")).to_be_visible()
    assert run.answers == [*[(1,)] * 4, tuple(50 + index for index in range(1, 11))]
    assert run.replies == ["right", "a 1 b", "a 1 b"]
    assert "A" in run.actuator


def play_by_keys(page: Page, screen: Trial) -> None:
    labels = [interval.label for interval in screen.intervals]
    if screen.in_order:
        page.keyboard.press(" ")
    elif screen.switches:
        for _ in labels:
            page.keyboard.press("ArrowRight")
    else:
        for label in labels:
            expect(page.locator(f"[data-label='{label}']")).to_be_enabled()
            page.keyboard.press(label if screen.number == 1 else " ")
            expect(page.locator(f"[data-label='{label}'] small")).to_have_text("playing")
            page.keyboard.press("Escape")
    expect(page.locator("[data-choice='1']")).to_be_enabled()


def rate_by_keys(page: Page, screen: Trial) -> None:
    page.keyboard.press(" ")
    expect(page.locator("[data-label='reference']")).to_be_enabled()
    page.keyboard.press("r")
    for index, interval in enumerate(screen.intervals[1:], 1):
        page.keyboard.press("ArrowRight")
        expect(page.locator(f"[data-slider='{interval.label}']")).to_be_focused()
        for _ in range(index):
            page.keyboard.press("ArrowUp")
    page.keyboard.press("Enter")


def test_nothing_can_be_answered_before_all_was_felt(browser: Browser) -> None:
    run = StubRun([GRADING, mushra(5)])
    with served(run) as (address, _), opened(browser, address) as page:
        for grade in GRADES:
            expect(page.get_by_role("button", name=grade, exact=False).first).to_be_disabled()
        page.click("[data-label='R']")
        expect(page.locator("[data-label='R'] small")).to_have_text("playing")
        expect(page.locator("[data-choice='0']")).to_be_disabled()
        expect(page.locator("[data-label='A']")).to_be_disabled()
        page.click("button:has-text('Stop')")
        page.click("[data-label='A']")
        page.dblclick("[data-choice='0']")
        expect(page.locator("[data-slider='A']")).to_be_disabled()
        page.click("[data-label='A']")
        expect(page.locator("[data-slider='A']")).to_be_enabled()
        expect(page.locator("[data-slider='B']")).to_be_disabled()
        expect(page.locator("button.main")).to_be_disabled()
    assert run.answers == [(0,)]


def test_feedback_and_the_count_of_plays(browser: Browser) -> None:
    run = StubRun([SAME_DIFFERENT, ABX])
    with served(run) as (address, _), opened(browser, address) as page:
        expect(page.locator("#progress-text")).to_have_text("Practice, trial 2 of 3")
        expect(page.locator("[data-label='1']")).to_be_disabled()
        page.keyboard.press(" ")
        expect(page.locator("[data-choice='0']")).to_be_enabled()
        expect(page.locator("button.play")).to_be_disabled()
        page.click("[data-choice='0']")
        expect(page.get_by_role("heading", name="Not correct")).to_be_visible()
        wait_for_screen(page, ABX)
        expect(page.locator("#progress-text")).to_have_text("Trial 3")
        for left in ("1 left", "0 left"):
            page.click("[data-label='B']")
            expect(page.locator("[data-label='B'] small")).to_have_text("playing")
            page.keyboard.press("Escape")
            expect(page.locator("[data-label='B'] small")).to_have_text(left)
        expect(page.locator("[data-label='B']")).to_be_disabled()


def test_a_reload_within_a_trial_loses_nothing(browser: Browser) -> None:
    run = StubRun([mushra(1, 2)])
    with served(run) as (address, _), opened(browser, address) as page:
        page.click("[data-label='A']")
        expect(page.locator("[data-slider='A']")).to_be_focused()
        page.keyboard.press("ArrowUp")
        expect(page.locator("output").first).to_have_text("51")
        page.reload()
        expect(page.locator("output").first).to_have_text("51")
        expect(page.locator("[data-label='A'] small")).to_have_text("playing")
        page.keyboard.press("Escape")
        expect(page.locator("[data-label='A'] small")).to_have_text("1 ×")
        for label in ("reference", "B"):
            page.click(f"[data-label='{label}']")
        expect(page.locator("[data-slider='B']")).to_be_focused()
        page.keyboard.press("ArrowDown")
        page.click("button.main")
        expect(page.get_by_role("heading", name="Thank you")).to_be_visible()
    assert run.answers == [(51, 49)]


def test_the_experimenter_pauses_and_aborts(browser: Browser) -> None:
    run = StubRun([GRADING])
    with served(run) as (address, secret), opened(browser, address) as page, opened(browser, secret) as experimenter:
        page.click("[data-label='A']")
        expect(experimenter.locator("#playing")).to_have_text("A")
        expect(experimenter.locator("#level")).to_have_text("23.4 dB")
        expect(experimenter.locator("#page")).to_have_text("connected")
        assert experimenter.evaluate("document.scrollingElement.scrollHeight <= innerHeight")
        assert not [word for word in CONDITIONS if word in experimenter.content() + page.content()]
        experimenter.click("#pause")
        expect(page.get_by_role("heading", name="Please wait.")).to_be_visible()
        assert run.actuator == ["A", "rest"]
        experimenter.get_by_role("button", name="Resume").click()
        page.click("[data-label='R']")
        expect(experimenter.locator("#playing")).to_have_text("R")
        experimenter.dblclick("#abort")
        expect(experimenter.locator("#abort")).to_have_text(re.compile("Press again"))
        expect(experimenter.locator("#status")).to_have_text("Running")
        experimenter.wait_for_timeout(600)
        experimenter.click("#abort")
        expect(experimenter.locator("#status")).to_have_text("The run has ended.")
        expect(page.get_by_role("heading", name="Thank you")).to_be_visible()
        assert run.actuator[:4] == ["A", "rest", "R", "rest"]
        assert set(run.actuator[4:]) <= {"rest"}, "the server stops it again at its end"


def test_a_lost_device_calls_the_experimenter(browser: Browser) -> None:
    run = StubRun([GRADING])
    run.fails = LOST
    run.warnings = tuple(f"underrun {number}: {'a long line ' * 20}" for number in range(60))
    with served(run) as (address, secret), opened(browser, address) as page, opened(browser, secret) as experimenter:
        page.click("[data-label='A']")
        expect(page.get_by_role("heading", name=CALL_THE_EXPERIMENTER)).to_be_visible()
        expect(experimenter.locator("#fault")).to_have_text(str(LOST))
        assert "ttyACM0" not in page.content()
        for width, height in SIZES:
            experimenter.set_viewport_size({"width": width, "height": height})
            assert experimenter.evaluate("document.scrollingElement.scrollHeight <= innerHeight")
            expect(experimenter.locator("#abort")).to_be_in_viewport(ratio=1)
        expect(experimenter.locator("#warnings li").nth(1)).to_contain_text("underrun 59")
        experimenter.get_by_role("button", name="Resume").click()
        wait_for_screen(page, GRADING)
        expect(experimenter.locator("#fault")).to_be_hidden()


def test_noise_and_pace(browser: Browser) -> None:
    run = StubRun([GRADING])
    aids = Aids(masking_noise_dbfs=-20.0, strokes_per_minute=40.0)
    with served(run, aids) as (address, _), opened(browser, address) as page:
        expect(page.get_by_role("heading", name=re.compile("headphones"))).to_be_visible()
        assert_fits(page)
        page.keyboard.press("Enter")
        wait_for_screen(page, GRADING)
        assert_fits(page)
        expect(page.get_by_role("img", name="pace of the hand: 40 strokes a minute")).to_be_visible()
        deadline = time.monotonic() + 20
        while not 0.09 < page.evaluate("sound.noise?.gain.value ?? 0") < 0.11:
            assert time.monotonic() < deadline
            page.wait_for_timeout(20)


def address_of(process: "subprocess.Popen[str]") -> str:
    """Return the participant's address that a program prints, once it serves both pages."""
    assert process.stdout is not None
    lines: list[str] = []
    while not any(line.startswith("experimenter: ") for line in lines):
        lines.append(process.stdout.readline())
        assert lines[-1], lines
    return next(line for line in lines if line.startswith("participant: ")).split(": ")[1].strip()


PROGRAM = """
import sys
from pathlib import Path
from tests.study.stub_run import StubRun, trial
from vibrocast.study.server import serve

run = StubRun([trial(number) for number in range(1, 4)], Path(sys.argv[1]))
run._changes = 5
serve(run, port=int(sys.argv[2]), say=lambda line: print(line, flush=True))
print(run.actuator[-1])
"""


def test_a_page_goes_on_after_the_server_was_killed(browser: Browser, tmp_path: Path) -> None:
    file = tmp_path / "answers.json"

    def start(port: str) -> tuple["subprocess.Popen[str]", str]:
        process = subprocess.Popen(
            [sys.executable, "-c", PROGRAM, str(file), port], stdout=subprocess.PIPE, text=True, stderr=subprocess.PIPE
        )
        return process, address_of(process)

    def answer(page: Page, number: int) -> None:
        expect(page.locator("#progress-text")).to_have_text(f"Trial {number} of 3")
        for label in "AB":
            page.click(f"[data-label='{label}']")
            page.click("button:has-text('Stop')")
        page.click(f"[data-choice='{number}']")

    process, address = start("0")
    with opened(browser, address) as page:
        answer(page, 1)
        expect(page.locator("#progress-text")).to_have_text("Trial 2 of 3")
        page.click("[data-label='A']")
        process.kill()
        process.communicate()
        expect(page.get_by_role("alert")).to_have_text("No connection. Please wait.")
        process, _ = start(address.rstrip("/").rsplit(":", 1)[1])
        answer(page, 2)
        answer(page, 3)
        expect(page.get_by_role("heading", name="Thank you")).to_be_visible()
        assert process.communicate(timeout=20)[0] == "rest\n"
    assert json.loads(file.read_text())[1] == [[1], [2], [3]]


@pytest.mark.slow
def test_ctrl_c_leaves_the_actuator_at_rest(tmp_path: Path) -> None:
    program = PROGRAM.replace("serve(run", "try: serve(run").replace(
        "print(run.act", "except KeyboardInterrupt: print(run.act"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", program, str(tmp_path / "answers.json"), "0"], stdout=subprocess.PIPE, text=True
    )
    address_of(process)
    process.send_signal(signal.SIGINT)
    assert process.communicate(timeout=20)[0] == "rest\n"
