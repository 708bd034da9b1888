"""Tests of text files: columns, names, rates, units, and whatever else a text file may hold."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vibrocast.textures import TextureError, load
from vibrocast.textures.axes import dft321


def written(folder: Path, text: str, name: str = "file.csv") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("text", "rate_hz", "unit", "samples"),
    [
        ("# rate_hz: 2800\n# unit: m/s^2\n1\n-2.5\n", 2800, "m/s^2", [[1], [-2.5]]),
        ("rate_hz = 500\nheight_um\n1\n2\n\n3\n", 500, "um", [[1], [2], [3]]),
        ("time_s,x (m/s^2)\n0,1\n0.001,2\n0.002,4\n", 1000, "m/s^2", [[1], [2], [4]]),
        ("time_ms;x_mm;y [mm]\n0;1;2\n2;3;4\n", 500, "um", [[1000, 2000], [3000, 4000]]),
        ("t (us)\tacceleration_g\r\n0\t1\r\n100\t-1\r\n", 10000, "m/s^2", [[9.80665], [-9.80665]]),
        ("time_s  x (m/s2)  y (m/s2)\n0.0 1 2\n0.5 3 5\n", 2, "m/s^2", [[1, 2], [3, 5]]),
        ('# rate_hz: 10\n"left (um)","right (µm)"\n1,2 # first\n3,4\n', 10, "um", [[1, 2], [3, 4]]),
        ("\ufeff# rate_hz: 10\n# unit: full scale\n# a remark\n0.5,5e-1\n", 10, "full scale", [[0.5, 0.5]]),
        ("# rate_hz: 10\nx_um,y_um,\n1,2,\n3,4, # last\n", 10, "um", [[1, 2], [3, 4]]),
        ('# rate_hz: 10\n"left, raw (um)","right (um)"\n"1","-2.5"\n"3","4"\n', 10, "um", [[1, -2.5], [3, 4]]),
        ("# rate_hz: 10\nchannel #1 (um), channel #2 (um)\n1,2\n", 10, "um", [[1, 2]]),
        ("# rate_hz: 10\n# unit: um\n,x,y\n0,5,1\n1,6,2\n2,8,3\n", 10, "um", [[5, 1], [6, 2], [8, 3]]),
        ("Index;Time (ms);x_um\n1;0;5\n2;1;6\n", 1000, "um", [[5], [6]]),
        ("# rate_hz: 10\nsample_um,y_um\n0,5\n1,-6\n", 10, "um", [[0, 5], [1, -6]]),
        ("# rate_hz: 10\n# unit: um\n1,2 # a; b\n3,-4\n", 10, "um", [[1, 2], [3, -4]]),
    ],
)
def test_what_a_file_states(tmp_path: Path, text: str, rate_hz: float, unit: str, samples: list[list[float]]) -> None:
    recording = load(written(tmp_path, text))
    assert (recording.rate_hz, recording.unit, recording.name) == (rate_hz, unit, "file")
    np.testing.assert_allclose(recording.samples, samples)


ROWS = [(0.0, 1.5), (0.001, -0.25), (0.002, 3.0), (0.003, 0.5)]


def lines(delimiter: str = ",", comma: bool = False, form: str = "{:.3f}") -> str:
    rows = (delimiter.join(form.format(number) for number in row) for row in ROWS)
    return "".join(f"{row.replace('.', ',') if comma else row}\n" for row in rows)


@pytest.mark.parametrize(
    "text",
    [
        "Time,Channel A\n(s),(g)\n\n" + lines(),
        "x-axis,CH1\nsecond,gs\n" + lines(),
        "t\tx\n[s]\t[g]\n" + lines("\t"),
        "# time x\n# s g\n" + lines(" "),
        "sep=;\ntime_s;z_g\n" + lines(";"),
        '"sep=|"\ntime_s|z_g\n' + lines("|"),
        "Device: X16\nSerial,42\nRange (g),16\n\nTime (s),X (g)\n" + lines(),
        "Log of a desk; 3 sensors; 2 of them off\ntime_s;x_g\n" + lines(";"),
        "time_s,x_g\n" + lines() + "\n\n",
        "% a remark\n% time_s x_g\n" + lines(" "),
        "time_s;z_g\n" + lines(";", comma=True),
        "time_s\tz_g\n" + lines("\t", comma=True),
        "time_s z_g\n" + lines(" ", comma=True),
        '"time_s","z_g"\n' + lines('","', comma=True).replace("\n", '"\n"').join(('"', ""))[:-1],
        "sep=;\nZeit (s);z (g)\n".replace("Zeit", "Time") + lines(" ; ", comma=True, form="{:+.3e}"),
        "time_s,z_g,label\n" + lines().replace("\n", ",walk\n"),
        "time_s,z_g,event\n" + lines().replace("\n", ",\n")[:-1] + "tap\n",
    ],
)
def test_layouts(tmp_path: Path, text: str) -> None:
    recording = load(written(tmp_path, text), columns=2)
    assert (recording.rate_hz, recording.unit, recording.notes) == (1000, "m/s^2", ())
    np.testing.assert_allclose(recording.samples[:, 0] / 9.80665, [row[1] for row in ROWS])


@pytest.mark.parametrize(
    ("end", "left_out"),
    [("Rate 1344, overflows 0\n", 1), ("\nTotal,60\nEnd of file\n", 2), ("0.06,", 1), ("0.06,-1.2,", 1), ("60", 1)],
)
def test_lines_below_the_samples_are_left_out_with_a_note(tmp_path: Path, end: str, left_out: int) -> None:
    body = "".join(f"{place / 1000},{place % 7},1\n" for place in range(60))
    path = written(tmp_path, f"time_s,x_g,y_g\n{body}{end}")
    recording = load(path)
    assert len(recording.samples) == 60
    place = 62 + end.startswith("\n")
    assert f"left out {left_out} line(s) behind the samples, from line {place}, " in recording.notes[0]
    with pytest.raises(TextureError, match=r"line 62, 'oops' is not 3 numbers as the lines above it; repair"):
        load(written(tmp_path, f"time_s,x_g,y_g\n{body}oops\n{body}"))


def test_lines_above_the_layout_are_passed_over_on_request(tmp_path: Path) -> None:
    text = "".join(f"{place},{place % 3}\n" for place in range(30)) + "\ntime_s,x_g,y_g\n"
    text += "".join(f"{place / 1000},{place % 7},1\n" for place in range(20))
    with pytest.raises(TextureError, match=r"line 32, 'time_s,x_g,y_g' is not 2 numbers .* with `skip_lines`"):
        load(written(tmp_path, text))
    assert load(written(tmp_path, text), skip_lines=30).samples.shape == (20, 2)
    prose = written(tmp_path, "words\n" * 1500 + text)
    with pytest.raises(TextureError, match=r"'words' is not a line of numbers; .* `skip_lines`"):
        load(prose)
    assert load(prose, skip_lines=1530).samples.shape == (20, 2)


@pytest.mark.parametrize(
    ("unit", "options", "per_unit"),
    [
        ("mg", {}, 9.80665e-3),
        ("mm/s²", {}, 1e-3),
        ("V", {"sensitivity": "100mV/g"}, 98.0665),
        ("mV", {"sensitivity": "0.1V/g"}, 0.0980665),
        ("counts", {"sensitivity": "256/g"}, 9.80665 / 256),
        ("", {"sensitivity": "2mV/(m/s^2)", "unit": "mV"}, 0.5),
    ],
)
def test_units_of_sensors(tmp_path: Path, unit: str, options: dict[str, str], per_unit: float) -> None:
    recording = load(written(tmp_path, f"time_s,z ({unit})\n{lines()}"), **options)  # type: ignore[arg-type]
    np.testing.assert_allclose(recording.samples[:, 0], [per_unit * row[1] for row in ROWS])


def test_what_a_file_does_not_state_is_given(tmp_path: Path) -> None:
    path = written(tmp_path, "1\n2\n")
    recording = load(path, rate_hz=1000, unit="g")
    assert (recording.rate_hz, recording.unit) == (1000, "m/s^2")
    np.testing.assert_allclose(recording.samples, [[9.80665], [2 * 9.80665]])
    np.testing.assert_allclose(load(path, rate_hz=1, unit="um", full_scale=40).samples, [[40], [80]])
    drive = load(path, rate_hz=1, unit="drive")
    assert (drive.unit, drive.samples.tolist()) == ("full scale", [[1], [2]])


def with_times(folder: Path, rate_hz: float, form: str, start_s: float = 0.0, count: int = 3000) -> Path:
    lines = [f"{start_s + index / rate_hz:{form}},{index % 7}" for index in range(count)]
    return written(folder, "\n".join(["time_s,x_um", *lines]))


@pytest.mark.parametrize("form", [".4f", ".5f", ".6f", ".9f", ".6g", ""])
@pytest.mark.parametrize("start_s", [0, 0.7, 12.34567])
@pytest.mark.parametrize("rate_hz", [1000, 2200, 2800])
def test_a_rate_is_not_lost_in_the_digits_of_times(tmp_path: Path, rate_hz: float, start_s: float, form: str) -> None:
    path = with_times(tmp_path, rate_hz, form, start_s)
    assert load(path).rate_hz == rate_hz
    assert load(path, rate_hz=rate_hz).rate_hz == rate_hz
    for other_hz in (0.998 * rate_hz, 1.002 * rate_hz):
        with pytest.raises(TextureError, match="leave out `rate_hz`"):
            load(path, rate_hz=other_hz)


def test_a_rate_that_the_digits_of_times_allow(tmp_path: Path) -> None:
    path = with_times(tmp_path, 2800.1, ".4f")
    assert load(path).rate_hz == 2800
    assert load(path, rate_hz=2800.1).rate_hz == 2800.1
    path.write_text("# rate_hz: 2800.1\n" + path.read_text())
    assert load(path).rate_hz == 2800.1


@pytest.mark.parametrize("rate_hz", [0.5, 12.5, 2800.5, 3333.25])
def test_a_rate_that_is_no_whole_number(tmp_path: Path, rate_hz: float) -> None:
    assert load(with_times(tmp_path, rate_hz, ".9f")).rate_hz == pytest.approx(rate_hz, rel=1e-6)
    assert load(with_times(tmp_path, rate_hz, ".9f", count=3)).rate_hz == pytest.approx(rate_hz, rel=1e-5)


@pytest.mark.parametrize(
    ("text", "options", "message"),
    [
        ("", {}, "no numbers"),
        ("x,y\n", {}, "no numbers"),
        ("1\n2\n", {"unit": "um"}, "give `rate_hz`"),
        ("1\n2\n", {"rate_hz": 10}, "give `unit`"),
        ("1\n2\n", {"rate_hz": 10, "unit": "um", "full_scale": -1}, "not positive"),
        ("1\n2\n", {"rate_hz": 10, "unit": "full scale", "full_scale": 3}, "give its `unit` too"),
        ("1\nnan\n", {"rate_hz": 10, "unit": "um"}, "/file.csv: sample 1 of channel 0 is nan"),
        ("1,2\n3\n", {"rate_hz": 10, "unit": "um"}, "line 2, '3' is not 2 numbers as the lines above it"),
        ("1,\n3,4\n", {"rate_hz": 10, "unit": "um"}, "line 2, '3,4' is not 1 number as"),
        ("some\nwords\n", {}, "'words' is not a line of numbers"),
        ("0,123\n0,5\n\n-1,25e-3\n", {"rate_hz": 10, "unit": "um"}, "decimal commas.* name each of the 2 columns"),
        ("x_um\n0,123\n0,5 # half\n", {"rate_hz": 10}, "decimal commas.* name each of the 2 columns"),
        ("time_s,x_um\n0,000,0,5\n0,001,0,7\n", {}, "decimal commas.* name each of the 4 columns"),
        ("x,y\n1\n", {}, "'x,y' does not name columns of numbers, of which there are 1"),
        ("x (furlong)\n1\n", {}, "unknown unit 'furlong'"),
        ("# rate_hz: fast\n1\n", {}, "'fast' is not a number"),
        ("# rate_hz: 10\nx_um\n1\n", {"rate_hz": 20}, "states 10 Hz; leave out `rate_hz`=20"),
        ("# rate_hz: 10\nx_um\n1\n", {"unit": "m/s^2"}, "states its unit"),
        ("# rate_hz: 10\nx_um,y_g\n1,2\n", {}, "different units"),
        ("# rate_hz: 10\nduration_ms\n1\n2\n", {}, "no column of a signal"),
        ("time_s,t_ms,x\n0,0,1\n1,1,1\n", {}, "say different rates: 'time' 1 Hz, 't' 1000 Hz"),
        ("index,time_s\n0,0\n1,1\n", {}, "no column of a signal"),
        ("time_s,x_um\n0,1\n1,1\n5,1\n", {}, "a gap of 4 after line 3, where the usual step is 1"),
        ("time_s,x_um\n0,1\n0,1\n", {}, "does not state its sample rate; give `rate_hz`"),
        ("time_s,x_um\n0,1\n", {}, "a single line"),
        ("time_s,x_um\n0,1\nnan,1\n", {}, "line 3 holds no number"),
        ("# rate_hz: 3\ntime_s,x_um\n0,1\n1,1\n", {}, "the time column says 1 Hz; a comment says 3 Hz; correct one"),
        ("time,x_um\n0,1\n1,1\n", {}, "1 Hz in s, 1000 Hz in ms, 1e[+]06 Hz in us.*; name it .* or give `rate_hz`"),
        ("0,5\n1,6\n2,-8\n", {"rate_hz": 10, "unit": "um"}, "column 1 rises like a time or an index"),
        ("1\n2\n", {"columns": "x"}, "no column is 'x'; choose with `columns` among 1"),
        ("1\n2\n", {"columns": ""}, "`columns` names none"),
        ("1\n2\n", {"key": "a"}, "leave it out"),
        ("1\n2\n", {"hand_speed_mm_s": 5}, "leave out `hand_speed_mm_s`"),
        (
            "time (g),x_um\n0,1\n1,1\n",
            {},
            "'time' is in g; name it time_s, time_ms, time_us or time_ns",
        ),
        ("time_s,x_um\n0,1\n1e-318,1\n", {}, "says inf Hz, which no sensor has"),
        ("time,x_um\n0,1\n1e-318,1\n", {}, "states no unit"),
        ("time_s,x_V\n0,1\n1,2\n", {}, "is in V; give the sensor's `sensitivity`, such as 10.2mV/g"),
        ("time_s,x_V\n0,1\n1,2\n", {"unit": "g"}, "leave out `unit` and `full_scale`, and give .* `sensitivity`"),
        ("time_s,x_mV\n0,1\n1,2\n", {"sensitivity": "256/g"}, "is in mV, and `sensitivity`=256/g in counts"),
        ("time_s,x_g\n0,1\n1,2\n", {"sensitivity": "10mV/g"}, "is in g, and `sensitivity`=10mV/g in volts; correct"),
        ("time_s,x\n0,1\n1,2\n", {"sensitivity": "10mV/g"}, "unknown unit, .*; give `unit`, one of uV, mV, V"),
        ("time_s,x\n0,1\n1,2\n", {"sensitivity": "ten"}, "'ten' is no sensitivity; write one such as"),
        ("# unit: um\ntime_s,x_g\n0,1\n1,2\n", {}, "a comment says um, and the columns g; correct one of them"),
        ("time_s,speed_mm_s\n0,1\n1,2\n", {}, "column 'speed': unknown unit 'mm/s'"),
        ("time_s,x\n0,1\n1,2\n", {}, "give `unit`, .*; for counts of a sensor, `sensitivity`"),
        ("t;x (g)\n0;2,0\n1;1.234,5\n2;1.234,6\n", {}, "column 'x' holds no numbers: '1.234,5' is none; choose"),
        ("\0\0\0", {}, "not a text file"),
        ("7" * 200_000, {}, "not a text file"),
    ],
)
def test_rejected_with_what_to_do(tmp_path: Path, text: str, options: dict[str, float], message: str) -> None:
    with pytest.raises(TextureError, match=message):
        load(written(tmp_path, text), **options)  # type: ignore[arg-type]


@pytest.mark.parametrize(("step", "unit"), [(0.1, "ms"), (1, "ms"), (100, "us"), (500, "us")])
def test_a_time_column_of_another_unit_must_state_it(tmp_path: Path, step: float, unit: str) -> None:
    rate_hz = {"ms": 1e3, "us": 1e6}[unit] / step
    lines = "\n".join(f"{index * step:g},{index % 7}" for index in range(100))
    path = written(tmp_path, f"time,x_um\n{lines}")
    with pytest.raises(TextureError, match=rf"'time' states no unit.* {rate_hz:g} Hz in {unit}.* or give `rate_hz`"):
        load(path)
    assert load(path, rate_hz=rate_hz).rate_hz == rate_hz
    with pytest.raises(TextureError, match="the time column says"):
        load(path, rate_hz=1.01 * rate_hz)
    assert load(written(tmp_path, f"# rate_hz: {rate_hz}\ntime,x_um\n{lines}")).rate_hz == rate_hz
    assert load(written(tmp_path, f"time_{unit},x_um\n{lines}")).rate_hz == rate_hz


def test_three_axes_are_kept_chosen_or_reduced(tmp_path: Path) -> None:
    rows = np.array([[1, 5, 2], [2, 3, 4], [1, 1, 1], [0, 4, 1]])
    lines = [f"{z},{x},{y}" for x, y, z in rows]
    path = written(tmp_path, "# rate_hz: 10\nZ (um),X (um),Y (um)\n" + "\n".join(lines))
    for recording in (load(path), load(path, reduce="none")):
        assert recording.axes == ("X", "Y", "Z")
        np.testing.assert_array_equal(recording.samples, rows)
    for recording, samples in (
        (load(path, columns="y"), rows[:, [1]]),
        (load(path, reduce="norm"), np.sqrt(np.sum(rows**2, axis=1, keepdims=True))),
        (load(path, reduce="dft321"), dft321(rows.astype(float))),
    ):
        assert recording.axes == ()
        np.testing.assert_allclose(recording.samples, samples)


@pytest.mark.parametrize(
    "names", ["", "left_um,middle_um,right_um", "x_um,x_um,y_um", "x_um,y_um", "ax_um,by_um,cz_um"]
)
def test_other_columns_are_textures_of_their_own(tmp_path: Path, names: str) -> None:
    row = "1,5,2" if names.count(",") != 1 else "1,5"
    path = written(tmp_path, f"# rate_hz: 10\n# unit: um\n{names}\n{row}\n{row}\n")
    assert load(path).axes == ()


def test_three_columns_without_names_are_axes_on_request(tmp_path: Path) -> None:
    path = written(tmp_path, "# rate_hz: 10\n# unit: um\n1,5,2\n2,3,4\n1,1,1\n")
    assert load(path).axes == ()
    assert load(path, reduce="none").axes == ("X", "Y", "Z")
    np.testing.assert_allclose(load(path, columns="Y").samples, [[5], [3], [1]])
    for options, message in (
        ({"columns": "x", "reduce": "norm"}, "reduce needs three channels"),
        ({"reduce": "mean"}, "`reduce`=mean: not one of dft321, norm, none"),
    ):
        with pytest.raises(TextureError, match=message):
            load(path, **options)  # type: ignore[arg-type]


def test_other_encodings_are_rejected(tmp_path: Path) -> None:
    path = tmp_path / "file.csv"
    for encoding in ("utf-16", "latin-1"):
        path.write_text("height_µm\n1\n", encoding=encoding)
        with pytest.raises(TextureError, match="UTF-8"):
            load(path, rate_hz=10)


@given(
    values=st.lists(st.tuples(*[st.floats(-1e6, 1e6)] * 2), min_size=1),
    delimiter=st.sampled_from([",", ";", "\t", " "]),
)
def test_numbers_come_back(
    tmp_path_factory: pytest.TempPathFactory, values: list[tuple[float, float]], delimiter: str
) -> None:
    lines = [f"{left!r}{delimiter}{right!r}" for left, right in values]
    path = written(tmp_path_factory.getbasetemp(), "\n".join([f"a_um{delimiter}b_um", *lines]), "numbers.csv")
    try:
        assert load(path, rate_hz=10).samples.tolist() == [list(pair) for pair in values]
    except TextureError as error:
        assert "rises like a time" in str(error)


WORDS = ["time_s", "position_um", "height_um", "x (g)", "# rate_hz: ", "unit: um", "1", "-2.5", "1e999", "nan", "0x10"]
PIECES = st.sampled_from([*WORDS, *'\t \n\r,;"#[)_\0\ufeff\x85\u2028é'])


@given(text=st.lists(PIECES, max_size=40).map("".join) | st.text())
def test_any_text_loads_or_is_rejected(tmp_path_factory: pytest.TempPathFactory, text: str) -> None:
    path = tmp_path_factory.getbasetemp() / "any.csv"
    path.write_bytes(text.encode("utf-8", "surrogatepass"))
    for options in ({}, {"rate_hz": 100.0, "unit": "um"}, {"hand_speed_mm_s": 10.0}):
        try:
            assert np.isfinite(load(path, **options).samples).all()
        except TextureError as error:
            assert str(error)
