"""Imports figures that others measured of other codecs on hard signals."""

import csv
import math
import re
from pathlib import Path

from vibrocast.errors import InputError
from vibrocast.evaluation.stability.maps import Cells, Map, table
from vibrocast.evaluation.stability.signals import FAILED_SNR_DB, NEARLY_SILENT, SILENT
from vibrocast.evaluation.stability.trials import Measured, Outcome, Trial

HELD_SNR_DB, FALL_DB = 3.0, 6.0
_COLUMNS = ("input", "codec", "setting", "status", "SNR_dB", "maxabs_out", "finite")
_EXIT_CODE = re.compile(r"rc=(-?\d+)")
_PATH = re.compile(r"\s?\S*/\S*")


def read_peers(path: Path) -> Cells:
    """Read a CSV file with at least the columns of _COLUMNS, each codec's settings from coarse to fine.

    Raises InputError where it is no such file, OSError where it cannot be read.
    """
    with path.open(newline="", encoding="utf-8") as file:
        try:
            rows = list(csv.DictReader(file))
            if not rows or any(row.get(name) is None for row in rows for name in _COLUMNS):
                raise InputError(f"{path}: a row lacks one of {', '.join(_COLUMNS)}; fill it")
            best_db: dict[tuple[str, str], float] = {}
            measured = [_measured(row, best_db) for row in rows]
        except (csv.Error, ValueError) as error:
            raise InputError(f"{path}: no table of hard signals ({error}); give a CSV file") from error
    return table([Trial(row["codec"], row["input"].replace("_", " "), row["setting"]) for row in rows], measured)


def _measured(row: dict[str, str], best_db: dict[tuple[str, str], float]) -> Measured:
    """Return the outcome of a row by the rules that PEERS states; `best_db`: of each codec and input so far."""
    if row["status"] != "ok":
        died = _EXIT_CODE.search(row["status"])
        if died and int(died[1]) < 0:
            return Measured(Outcome.FAILS, {}, f"the program died of signal {-int(died[1])}")
        return Measured(Outcome.REJECTED, {}, " ".join(_PATH.sub("", row["status"]).split()))
    largest, snr_db = float(row["maxabs_out"] or "nan"), float(row["SNR_dB"] or "nan")
    figures = {"snr_db": None if math.isnan(snr_db) else snr_db, "peak": None if math.isnan(largest) else largest}
    curve = row["codec"], row["input"]
    coarser_db = best_db.get(curve, -math.inf)
    best_db[curve] = max(coarser_db, figures["snr_db"] or -math.inf)
    if row["finite"] == "False":
        return Measured(Outcome.FAILS, figures, "not finite")
    if figures["snr_db"] is None:
        if largest > NEARLY_SILENT:
            return Measured(Outcome.FAILS, figures, f"noise of peak {largest:.2g}")
        return Measured(Outcome.DEGRADED if largest > SILENT else Outcome.HOLDS, figures)
    if snr_db < FAILED_SNR_DB:
        return Measured(Outcome.FAILS, figures, f"SNR {snr_db:z.1f} dB")
    if snr_db < coarser_db - FALL_DB:
        return Measured(Outcome.DEGRADED, figures, f"SNR {snr_db:z.1f} dB, {coarser_db:.1f} dB at a coarser setting")
    return Measured(Outcome.HOLDS if snr_db >= HELD_SNR_DB else Outcome.DEGRADED, figures, f"SNR {snr_db:z.1f} dB")


PEERS = Map("peers", globals())
