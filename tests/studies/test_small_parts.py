"""Decoders on four emulated processors: each decodes to the same bits, in the memory that the page states."""

from pathlib import Path

import numpy as np
import pytest

from studies import small_parts
from studies.emulated_core import Core, EmulatedCore
from studies.small_parts import PROCESSORS, Cost
from tests.firmware.boards import coded
from vibrocast.evaluation import points

PAGE = Path(__file__).parents[2] / "docs" / "benchmarks"
ROWS = points.read_rows(PAGE / "results" / small_parts.TABLE, Cost)


@pytest.mark.slow
@pytest.mark.parametrize("processor", PROCESSORS, ids=lambda processor: processor.title)
def test_each_processor_decodes_to_the_same_bits(tmp_path: Path, processor: Core) -> None:
    stream = coded("slp", 0.2, channels=1)
    core = EmulatedCore(small_parts.compile_decoder(tmp_path / "slp.elf", processor, "slp"), processor)
    ram, per_sample = small_parts.run(core, processor, bytes(stream), None)
    (row,) = (row for row in ROWS if (row.processor, row.decoder) == (processor.title, "slp"))
    assert row.ram == ram
    assert row.flash == pytest.approx(core.flash_bytes, 0.02)
    assert row.per_sample is not None and per_sample < row.per_sample
    assert core.stack_bytes < 4096
    last = stream.decode_integers()[-stream.decoder().packet_samples :]
    samples = np.frombuffer(core.read(small_parts._SAMPLES, 2 * last.size), "<i2")
    np.testing.assert_array_equal(samples, last.ravel())


def test_the_page_has_every_decoder_on_every_processor() -> None:
    assert {(row.processor, row.decoder) for row in ROWS} == {
        (processor.title, decoder) for processor in PROCESSORS for decoder in small_parts.DECODERS
    }
    assert max(row.stack for row in ROWS) <= 4096  # as vibrocast/decoder.h says
