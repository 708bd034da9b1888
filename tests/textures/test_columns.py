"""Tests of columns: which of a text file are times, counts, axes and channels, and how you choose others."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas
import polars
import pytest

from vibrocast.textures import TextureError, from_array, load
from vibrocast.textures.recording import spelt

RATE_HZ = 800
NOISE = np.random.default_rng(5).normal(size=(40, 9))


def written(folder: Path, header: str, delimiter: str = ",", times: int = 1) -> Path:
    """Write 40 rows under a header: seconds in the first `times` columns, noise in the others."""
    seconds = np.arange(len(NOISE)) / RATE_HZ
    columns = [seconds + 100 * number for number in range(times)]
    noise = NOISE[:, : header.count(delimiter) + 1 - times]
    rows = np.column_stack([*columns, noise])
    path = folder / "file.csv"
    np.savetxt(path, rows, fmt="%.9f", delimiter=delimiter, header=header, comments="")
    return path


@pytest.mark.parametrize(
    ("header", "times", "order"),
    [
        ("time_s,seconds_elapsed,z,y,x", 2, [2, 1, 0]),  # a phone's log
        ("#time,accel_x,accel_y,accel_z", 1, [0, 1, 2]),  # a printer's
        ("Time (s),Acceleration x (g),Acceleration y (g),Acceleration z (g),Absolute acceleration (g)", 1, [0, 1, 2]),
        ("Zeit (s),Beschleunigung x (g),Beschleunigung y (g),Beschleunigung z (g),Norm (g)", 1, [0, 1, 2]),
        ("elapsed_s,AccelX,AccelY,AccelZ", 1, [0, 1, 2]),
        ("# t [s],Linear Acceleration x,Linear Acceleration y,Linear Acceleration z,total", 1, [0, 1, 2]),
        ("time_of_week (s),uptime_s,Y-Axis,X-Axis,Z-Axis", 2, [1, 0, 2]),
        ("gps time [s],seconds,userAcceleration.z,userAcceleration.x,userAcceleration.y,magnitude", 2, [1, 2, 0]),
    ],
)
def test_times_and_axes_are_known_by_name_in_any_order(
    tmp_path: Path, header: str, times: int, order: list[int]
) -> None:
    path = written(tmp_path, header, times=times)
    recording = load(path, unit=None if "(g)" in header else "g")
    assert (recording.rate_hz, recording.axes) == (RATE_HZ, ("X", "Y", "Z"))
    np.testing.assert_allclose(recording.samples, 9.80665 * NOISE[:, order], atol=1e-7)


@pytest.mark.parametrize(
    ("header", "unknown"),
    [
        ("time_s,ax,ay,az,gx,gy,gz", "'gx', 'gy', 'gz'"),
        ("time_s,x,y,z,battery", "'battery' is"),
        ("time_s,x (g),y (g),z (g),temperature (C)", "'temperature' is"),
        ("time_s,label,z", "'label' is"),
        ("time_s,acc_x,acc_y,acc_z,mag_x,mag_y,mag_z", "'mag_x', 'mag_y', 'mag_z'"),
        ("time_s,a1_x,a1_y,a1_z,a2_x,a2_y,a2_z", "'a1_x', 'a1_y', 'a1_z', 'a2_x'"),
        ("time_s,force,speed", "'force', 'speed'"),
        ("time_s,a x (g),a y (g),a z (g),gravity x (g),gravity y (g),gravity z (g)", "'a x', 'a y', .* 'gravity z'"),
    ],
)
def test_an_unknown_column_is_an_error_that_lists_all(tmp_path: Path, header: str, unknown: str) -> None:
    path = written(tmp_path, header)
    unit = None if "(g)" in header else "g"
    names = [name.partition(" (")[0] for name in header.replace("time_s", "time").split(",")]
    with pytest.raises(TextureError, match=unknown) as raised:
        load(path, unit=unit)
    assert all(f"{number} {name!r}" in str(raised.value) for number, name in enumerate(names, 1))
    assert "`columns`" in str(raised.value)
    last = load(path, unit="g" if "C" not in header else None, columns=[2])
    assert (last.channels, last.rate_hz) == (1, RATE_HZ)


def test_columns_are_chosen_by_name_axis_or_number(tmp_path: Path) -> None:
    path = written(tmp_path, "time_s,ax,ay,az,gx,left raw")
    for columns, order in (
        ("ax", [0]),
        ("z,AX", [2, 0]),
        ("2,3,4", [0, 1, 2]),
        (3, [1]),
        (["az", 5], [2, 3]),
        ('"left raw"', [4]),
        (["left raw"], [4]),
    ):
        recording = load(path, unit="m/s^2", columns=columns)  # type: ignore[arg-type]
        np.testing.assert_allclose(recording.samples, NOISE[:, order], atol=1e-7)
        assert bool(recording.axes) == (order == [0, 1, 2])
    norm = load(path, unit="m/s^2", columns="ax,ay,az", reduce="norm").samples
    np.testing.assert_allclose(norm[:, 0], np.linalg.norm(NOISE[:, :3], axis=1), atol=1e-7)
    for wrong in ("q", "7"):
        with pytest.raises(TextureError, match=f"no column is '{wrong}'; choose .* 1 'time', 2 'ax'"):
            load(path, unit="m/s^2", columns=wrong)
    with pytest.raises(TextureError, match=r"several columns are 'x'; choose .* 2 'a1_x', 3 'a2_x'"):
        load(written(tmp_path, "time_s,a1_x,a2_x"), unit="m/s^2", columns="x")


def test_a_column_that_rises_is_no_axis_and_one_of_text_no_signal(tmp_path: Path) -> None:
    path = tmp_path / "file.csv"
    for header in ("", "x,y\n"):
        path.write_text(header + "".join(f"{place**1.1},{place % 7}\n" for place in range(40)))
        with pytest.raises(TextureError, match=r"column 1 rises like a time or an index; .* `columns`"):
            load(path, rate_hz=100, unit="g")
        assert load(path, rate_hz=100, unit="g", columns="2").channels == 1
    path.write_text("".join(f"{place % 7},walk\n" for place in range(40)))
    with pytest.raises(TextureError, match="column 2 holds no numbers: 'walk' is none"):
        load(path, rate_hz=100, unit="g", columns="2")


def test_columns_of_different_units_are_named(tmp_path: Path) -> None:
    path = written(tmp_path, "time_s,x (g),y (mm)")
    with pytest.raises(TextureError, match=r"different units: 'x' in g, 'y' in mm; choose some with `columns`"):
        load(path)
    assert load(path, columns="y").unit == "um"


@pytest.mark.parametrize("make", [pandas.DataFrame, polars.DataFrame])
def test_the_columns_of_a_data_frame_count_as_names(make: Callable[[dict[str, Any]], Any]) -> None:
    columns = {"seconds_elapsed": np.arange(40) / RATE_HZ, "z": NOISE[:, 0], "x": NOISE[:, 1], "y": NOISE[:, 2]}
    recording = from_array(make(columns), None, "m/s^2")
    assert (recording.rate_hz, recording.axes) == (RATE_HZ, ("X", "Y", "Z"))
    np.testing.assert_array_equal(recording.samples, NOISE[:, [1, 2, 0]])
    np.testing.assert_array_equal(from_array(make(columns), None, "m/s^2", columns="z").samples, NOISE[:, :1])
    for more in ({"battery": np.full(40, 87)}, {"label": ["walk"] * 40}, {"gx": NOISE[:, 4]}):
        with pytest.raises(TextureError, match=f"whether '{next(iter(more))}' is to be played; .* `columns`"):
            from_array(make(columns | more), None, "m/s^2")
    moments = columns | {"time": pandas.date_range("2024-05-01", periods=40, freq="1250us")}
    assert from_array(make(moments), None, "m/s^2").rate_hz == RATE_HZ
    with pytest.raises(TextureError, match="`rate_hz` is missing"):
        from_array(make({"x": NOISE[:, 0]}), None, "m/s^2")


def test_a_data_frame_may_have_times_as_index_or_no_names() -> None:
    index = pandas.to_timedelta(np.arange(40) / RATE_HZ, unit="s")
    assert from_array(pandas.DataFrame({"x": NOISE[:, 0]}, index=index), None, "g").rate_hz == RATE_HZ
    assert from_array(pandas.DataFrame(NOISE), 100, None).channels == NOISE.shape[1]


@pytest.mark.parametrize(
    ("text", "unit"),
    [("G", "g"), ("mG", "mg"), ("Volt", "V"), ("m/s²", "m/s^2"), ("MM/S^2", "mm/s^2"), ("msec", "ms"), ("rad/s", None)],
)
def test_units_are_known_in_usual_spellings(text: str, unit: str | None) -> None:
    assert spelt(text) == unit


def test_channels_of_any_format_are_chosen(tmp_path: Path) -> None:
    path = tmp_path / "file.npy"
    np.save(path, NOISE[:, :3])
    facts = {"rate_hz": 100.0, "unit": "um"}
    for columns, order in (("3,1", [2, 0]), ("z", [2]), ("x,y,z", [0, 1, 2])):
        recording = load(path, columns=columns, **facts)  # type: ignore[arg-type]
        np.testing.assert_array_equal(recording.samples, NOISE[:, order])
    assert recording.axes == ("X", "Y", "Z")
    with pytest.raises(TextureError, match="no column is '4'"):
        load(path, columns="4", **facts)  # type: ignore[arg-type]
