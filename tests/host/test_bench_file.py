"""The bench file: its content, and every mistake reported with its place."""

import json
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vibrocast.errors import InputError
from vibrocast.host.bench_file import actuator_toml, choose_controller, read_bench
from vibrocast.output.actuator import (
    ACTUATORS,
    LRA,
    PIEZO_STACK,
    Actuator,
)

EXAMPLE = Path(__file__).parents[2] / "examples" / "bench.toml"
CONTROLLER = '[[controllers]]\nname = "left"\naddress = "sim"\n'
SENSOR = '[[sensors]]\nname = "laser"\nkind = "laser"\ncommand = ["record", "{file}"]\n'

SERIAL_INPUT = """
[[sensors]]
name = "accelerometer"
kind = "accelerometer"
input = "serial:/dev/ttyACM0@115200"
"""
INPUT = """
[[sensors]]
name = "accelerometer"
kind = "accelerometer"
input = "audio:USB Audio:2"
sensitivity = "10.2mV/g"
volts_full_scale = 2.1
"""


def test_the_example_is_a_bench() -> None:
    bench = read_bench(EXAMPLE)
    assert [controller.address for controller in bench.controllers] == ["sim", "sim-usb"]
    model = bench.actuator("left")
    assert model is not None
    assert model.corner_hz != PIEZO_STACK.corner_hz
    assert model.volts == PIEZO_STACK.volts
    assert bench.actuator("right") == LRA
    assert {recording.name for recording in bench.scene()} >= {"oak"}


@pytest.mark.parametrize("actuator", ACTUATORS.values(), ids=ACTUATORS)
def test_an_actuator_written_is_the_one_read(actuator: Actuator, tmp_path: Path) -> None:
    path = tmp_path / "bench.toml"
    path.write_text(CONTROLLER + actuator_toml(actuator, "left"))
    assert read_bench(path).actuator("left") == actuator


def test_an_impossible_texture_is_reported_with_its_place(tmp_path: Path) -> None:
    path = tmp_path / "bench.toml"
    path.write_text(CONTROLLER + '[[textures]]\ngenerate = "rough"\nseconds = 600\nrate_hz = 1e7\n')
    with pytest.raises(InputError, match=r"\[\[textures\]\] 1: 600.0 s at"):
        read_bench(path).scene()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[[motors]]\n", "there is no key motors; choose from controllers, actuators, sensors, textures"),
        ('[[controllers]]\nname = "a"\naddress = "com3"\n', "[[controllers]] 1: address must be an address"),
        (CONTROLLER + '[[actuators]]\nmodel = "muscle"\n', "[[actuators]] 1: model must be one of piezo-stack, "),
        (
            CONTROLLER + '[[actuators]]\nname = "x"\n',
            "[[actuators]] 1: stroke_um is missing; give it, or a model that has it: piezo-stack",
        ),
        (
            CONTROLLER + '[[actuators]]\nmodel = "lra"\nquality = 1e9\n',
            "quality = 1e+09 is out of range: Q of the resonance",
        ),
        (
            CONTROLLER + '[[actuators]]\nmodel = "lra"\nmaximum_boost = 900\n',
            "no controller can drive this actuator: ",
        ),
        (CONTROLLER + '[[actuators]]\nmodel = "lra"\ncontroller = "up"\n', "controller must be one of left, not 'up'"),
        (CONTROLLER + SENSOR.replace('"laser"\ncom', '"ear"\ncom'), "[[sensors]] 1: kind must be one of accelerometer"),
        (CONTROLLER + SENSOR.replace("{file}", "x.wav"), "command must be a list of a program and its arguments"),
        (CONTROLLER + SENSOR + "sensitivity = 0.1\n", "sensitivity needs its unit: add unit, such as 'm/s^2'"),
        (CONTROLLER + SENSOR.replace("record", "\\u0000"), "command must be a list of a program and its arguments"),
        (CONTROLLER + SENSOR + SENSOR.replace('name = "laser"', 'name = "b"'), "[[sensors]] 2: there is another one"),
        (
            CONTROLLER + SENSOR + 'input = "serial:P"\n',
            "[[sensors]] 1: give either command, a program that records, or",
        ),
        (CONTROLLER + INPUT.replace("audio:", ""), "input must be audio:CARD:CHANNEL or serial:PORT"),
        (CONTROLLER + INPUT.replace("10.2mV/g", "10.2"), "'10.2' is no sensitivity; write one such as 10.2mV/g"),
        (CONTROLLER + INPUT.replace('"10.2mV/g"', "10.2"), "sensitivity must be a text, such as 10.2mV/g"),
        (CONTROLLER + INPUT + 'unit = "g"\n', "[[sensors]] 1: there is no key unit; choose from name, "),
        (CONTROLLER + INPUT + "rate_hz = 100.5\n", "rate_hz must be sample rate in Hz, a whole number"),
        (CONTROLLER + SERIAL_INPUT.replace("@115200", "@9"), "9 is no baud rate; give 1200 to 20000000 behind the @"),
        (CONTROLLER + SENSOR + "volts_full_scale = 2.0\n", "[[sensors]] 1: there is no key volts_full_scale; "),
        (CONTROLLER + 2 * '[[actuators]]\nmodel = "lra"\n', "[[actuators]] 2: there is another one on that channel"),
        (CONTROLLER + '[[textures]]\nfile = "none.wav"\n', "does not exist"),
        (CONTROLLER + '[[textures]]\ngenerate = "silk"\n', "generate must be one of grating, "),
    ],
)
def test_a_mistake_is_reported_with_its_place(text: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "bench.toml"
    path.write_text(text)
    with pytest.raises(InputError) as raised:
        read_bench(path)
    assert str(raised.value).startswith(f"{path}: ")
    assert message in str(raised.value)


_VALUES = st.recursive(
    st.one_of(st.none(), st.booleans(), st.integers(-5, 5), st.text(max_size=3)),
    lambda inner: st.lists(inner, max_size=2),
)


@given(
    key=st.sampled_from(("name", "model", "stroke_um", "quality", "dac_bits", "channel", "controller")), value=_VALUES
)
def test_no_value_of_a_key_passes_unseen(key: str, value: object, tmp_path_factory: pytest.TempPathFactory) -> None:
    text = "\n".join(line for line in actuator_toml(LRA, "left").splitlines() if not line.startswith(f"{key} ="))
    path = tmp_path_factory.mktemp("bench") / "bench.toml"
    path.write_text(f"{CONTROLLER}{text}\n{key} = {json.dumps(value)}\n")
    try:
        bench = read_bench(path)
    except InputError:
        return
    assert isinstance(value, (str, int))
    assert isinstance(bench.actuators[0].model, Actuator)


def test_a_device_is_a_name_an_address_or_an_error() -> None:
    bench = read_bench(EXAMPLE)
    assert choose_controller(bench, "right").first.address == "sim-usb"
    assert choose_controller(bench, "sim-usb").first.name == "right"
    assert choose_controller(bench, "serial:/dev/ttyACM0").first.address == "serial:/dev/ttyACM0"
    assert choose_controller(None, None).first.address == "sim"
    with pytest.raises(InputError, match="'elsewhere' is no controller"):
        choose_controller(bench, "elsewhere")
