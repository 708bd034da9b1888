"""The page of the least delay: its table holds less than 10 ms, and the price in bits."""

import csv
from pathlib import Path

import pytest

import vibrocast
from studies import low_delay

TABLE = Path(__file__).parents[2] / "docs" / "benchmarks" / "results" / low_delay.TABLE


def test_the_table_leads_from_the_default_to_less_than_10_ms() -> None:
    with TABLE.open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["codec"] == "mdct"]
    for link in ("serial_ms", "usb_ms"):
        delays = [float(row[link]) for row in rows]
        assert delays == sorted(delays, reverse=True)
        assert delays[-1] < 10
    assert float(rows[-1]["wire_bps"]) > float(rows[0]["wire_bps"])


@pytest.mark.parametrize("frame", low_delay.OPUS_FRAMES)
def test_opus_reaches_the_snr(frame: str) -> None:
    row = low_delay.opus(vibrocast.load(low_delay.RECORDING), frame)
    assert row.snr_db >= low_delay.SNR_DB - 0.2
    assert row.wire_bps > row.payload_bps
    assert row.codec_ms == pytest.approx((int(frame) + 19) / 8, abs=0.01)
    assert f"| {row.rate_hz} | {row.block} |" in low_delay.page([row] * len(low_delay.CHAINS))
