"""The cost of decoders at worst: the firmware's figures hold for noise, and a board stays prompt; the page."""

from importlib.util import find_spec
from pathlib import Path

import pytest

from studies import worst_case
from studies.emulated_core import EmulatedCore
from studies.worst_case import Cost, Turn
from vibrocast import pages
from vibrocast.evaluation import points

pytestmark = pytest.mark.skipif(find_spec("ziglang") is None, reason="no compiler for microcontrollers")

BENCHMARKS = Path(__file__).parents[2] / "docs" / "benchmarks"
COSTS = points.read_rows(BENCHMARKS / "results" / worst_case.COSTS, Cost)
TURNS = points.read_rows(BENCHMARKS / "results" / worst_case.TURNS, Turn)
PROMPT_MS = 30.0


@pytest.fixture(scope="module")
def processor(tmp_path_factory: pytest.TempPathFactory) -> EmulatedCore:
    return worst_case.emulated(tmp_path_factory.mktemp("worst_case"))


@pytest.mark.parametrize(
    ("decoder", "block"),
    [("mdct", "128"), ("dct", "1024"), ("slp", "32"), ("parametric", "16"), ("eva-16", "")],
)
def test_noise_costs_no_more_than_the_firmware_states(decoder: str, block: str, processor: EmulatedCore) -> None:
    noise_cycles, stated_cycles = worst_case.noise(processor, decoder, block, channels=1)
    assert noise_cycles < stated_cycles < 1.2 * noise_cycles


def test_a_board_stops_at_once_whatever_it_decodes(processor: EmulatedCore) -> None:
    _, hostile = worst_case.measure(processor, "dct", "1024", 2, tries=2)
    turn = worst_case.on_board(hostile, "dct", 12_000, stops=2)
    assert turn.turn_ms is not None
    assert turn.stop_ms is not None
    assert 5 < turn.turn_ms < PROMPT_MS
    assert 0 < turn.stop_ms < PROMPT_MS


def test_a_board_rejects_a_stream_that_it_cannot_decode_in_time(processor: EmulatedCore) -> None:
    _, hostile = worst_case.measure(processor, "slp", "128", 2, tries=0)
    assert worst_case.on_board(hostile, "slp", 12_000, stops=1) == Turn("slp", 2, 12_000)


def test_the_tables_hold_what_the_page_says() -> None:
    assert all(cost.noise_cycles <= cost.stated_cycles for cost in COSTS)
    assert all((turn.stop_ms or 0.0) < PROMPT_MS and (turn.turn_ms or 0.0) < PROMPT_MS for turn in TURNS)
    shipped, _, _ = (BENCHMARKS / "worst_case.md").read_text().partition(f"\n{pages.FIGURES}")
    assert shipped == worst_case.rendered(COSTS, TURNS)
