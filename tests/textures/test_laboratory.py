"""Files of laboratory programs: what each states, what a key chooses, what is rejected."""

import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from nptdms import ChannelObject, TdmsWriter
from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_typestore

from tests.textures.damage import check_damaged
from vibrocast.textures import TextureError, load

NOISE = np.random.default_rng(0).normal(size=(200, 3))
RATE_HZ = 1000


def write_tdms(path: Path) -> None:
    stated = {"wf_increment": 1 / RATE_HZ, "unit_string": "g"}
    channels = [ChannelObject("acc", name, NOISE[:, number], stated) for number, name in enumerate("xyz")]
    with TdmsWriter(path) as writer:
        writer.write_segment([*channels, ChannelObject("log", "text", ["oak", "slow"])])


def write_lvm(path: Path, step: str = "1.0E-3") -> None:
    head = {"Writer_Version": "2", "Separator": "Tab", "Decimal_Separator": ".", "X_Columns": "One"}
    lines = ["LabVIEW Measurement\t", *("\t".join(each) for each in head.items()), "***End_of_Header***\t", "\t"]
    lines += ["Channels\t3\t\t\t", "Y_Unit_Label\tg\tg\tg\t", f"Delta_X\t{step}\t{step}\t{step}\t"]
    lines += ["***End_of_Header***\t\t\t\t", "X_Value\tx\ty\tz\tComment"]
    lines += [f"{number / RATE_HZ:.6f}\t" + "\t".join(map(repr, row)) for number, row in enumerate(NOISE.tolist())]
    path.write_text("\n".join(lines) + "\n")


def xdf_chunk(tag: int, content: bytes) -> bytes:
    content = struct.pack("<H", tag) + content
    return b"\x04" + struct.pack("<I", len(content)) + content


def write_xdf(path: Path, rate_hz: float = RATE_HZ, streams: int = 1) -> None:
    """Write streams after the specification of XDF 1.0: chunks of a header, of samples and of an end."""
    data = b"XDF:" + xdf_chunk(1, b"<?xml version='1.0'?><info><version>1.0</version></info>")
    for number in range(streams):
        channels = "".join(f"<channel><label>{name}</label><unit>g</unit></channel>" for name in "xyz")
        head = (
            f"<?xml version='1.0'?><info><name>acc{number}</name><type>ACC</type><channel_count>3</channel_count>"
            f"<nominal_srate>{rate_hz}</nominal_srate><channel_format>double64</channel_format>"
            f"<desc><channels>{channels}</channels></desc></info>"
        )
        name = struct.pack("<I", number)
        data += xdf_chunk(2, name + head.encode())
        stamped = (b"\x08" + struct.pack("<d", 50 + at / RATE_HZ) + row.tobytes() for at, row in enumerate(NOISE))
        data += xdf_chunk(3, name + b"\x04" + struct.pack("<I", len(NOISE)) + b"".join(stamped))
        data += xdf_chunk(6, name + b"<info><first_timestamp>50</first_timestamp></info>")
    path.write_bytes(data)


def messages(store: Any, header: dict[str, int]) -> Any:
    """Yield time in ns and message of an inertial sensor, with clock times of today."""
    types = store.types
    for number, row in enumerate(NOISE.tolist()):
        time_ns = 1_700_000_000_000_000_000 + number * 10**9 // RATE_HZ
        stamp = types["builtin_interfaces/msg/Time"](time_ns // 10**9, time_ns % 10**9)
        vector, nothing = types["geometry_msgs/msg/Vector3"], np.zeros(9)
        yield (
            time_ns,
            types["sensor_msgs/msg/Imu"](
                types["std_msgs/msg/Header"](**header, stamp=stamp, frame_id="tool"),
                types["geometry_msgs/msg/Quaternion"](0, 0, 0, 1),
                nothing,
                vector(0, 0, 0),
                nothing,
                vector(*row),
                nothing,
            ),
        )


def write_bag(path: Path) -> None:
    store = get_typestore(Stores.ROS1_NOETIC)
    with rosbag1.Writer(path) as writer:
        topic = writer.add_connection("/imu", "sensor_msgs/msg/Imu", typestore=store)
        for time_ns, message in messages(store, {"seq": 0}):
            writer.write(topic, time_ns, store.serialize_ros1(message, "sensor_msgs/msg/Imu"))


def write_ros_folder(path: Path) -> None:
    store = get_typestore(Stores.LATEST)
    with rosbag2.Writer(path, version=9) as writer:
        topic = writer.add_connection("/imu", "sensor_msgs/msg/Imu", typestore=store)
        for time_ns, message in messages(store, {}):
            writer.write(topic, time_ns, store.serialize_cdr(message, "sensor_msgs/msg/Imu"))


FILES: dict[str, tuple[Callable[[Path], None], str, float]] = {
    "a.tdms": (write_tdms, "acc", 9.80665),
    "a.lvm": (write_lvm, "0", 9.80665),
    "a.xdf": (write_xdf, "acc0", 9.80665),
    "a.bag": (write_bag, "/imu", 1.0),
    "folder": (write_ros_folder, "/imu", 1.0),
}


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("keyed", [True, False])
def test_every_format_states_rate_unit_and_axes(tmp_path: Path, name: str, keyed: bool) -> None:
    write, key, factor = FILES[name]
    write(tmp_path / name)
    recording = load(tmp_path / name, key=key if keyed else None)
    assert (recording.rate_hz, recording.unit, recording.axes) == (RATE_HZ, "m/s^2", ("X", "Y", "Z"))
    np.testing.assert_allclose(recording.samples, NOISE * factor)


@pytest.mark.parametrize("name", FILES)
def test_an_unknown_key_is_rejected_with_the_known_ones(tmp_path: Path, name: str) -> None:
    write, key, _ = FILES[name]
    write(tmp_path / name)
    with pytest.raises(TextureError, match=f"no array of numbers `key`=nothing; there are {key}"):
        load(tmp_path / name, key="nothing")


@pytest.mark.parametrize("suffix", [".lvm", ".xdf"])
def test_a_file_that_its_parser_reads_whole_must_fit_into_memory(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"large{suffix}"
    with path.open("wb") as file:
        file.truncate(2**42)
    with pytest.raises(TextureError, match="GiB of memory"):
        load(path)


def test_a_channel_of_tdms_is_chosen(tmp_path: Path) -> None:
    write_tdms(tmp_path / "a.tdms")
    recording = load(tmp_path / "a.tdms", key="acc/y")
    np.testing.assert_allclose(recording.samples[:, 0], NOISE[:, 1] * 9.80665)


def test_times_state_the_rate_where_nothing_else_does(tmp_path: Path) -> None:
    write_lvm(tmp_path / "a.lvm", step="")
    write_xdf(tmp_path / "a.xdf", rate_hz=0)
    for name in ("a.lvm", "a.xdf"):
        assert load(tmp_path / name).rate_hz == RATE_HZ


def test_channels_of_several_rates_are_rejected(tmp_path: Path) -> None:
    channels = [ChannelObject("acc", name, NOISE[:, 0], {"wf_increment": step}) for name, step in (("a", 1), ("b", 2))]
    with TdmsWriter(tmp_path / "a.tdms") as writer:
        writer.write_segment(channels)
    with pytest.raises(TextureError, match="channels of several rates or lengths; choose one of a, b with `key`"):
        load(tmp_path / "a.tdms")


def test_one_of_several_streams_is_chosen(tmp_path: Path) -> None:
    write_xdf(tmp_path / "a.xdf", streams=2)
    with pytest.raises(TextureError, match="choose an array with `key`; there are acc0, acc1"):
        load(tmp_path / "a.xdf")
    assert load(tmp_path / "a.xdf", key="acc1").rate_hz == RATE_HZ


def test_a_pickle_next_to_a_file_is_left_alone(tmp_path: Path) -> None:
    write_lvm(tmp_path / "a.lvm")
    (tmp_path / "a.lvm.pkl").write_bytes(b"cos\nsystem\n(S'false'\ntR.")
    assert load(tmp_path / "a.lvm").rate_hz == RATE_HZ
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.lvm", "a.lvm.pkl"]


@given(changes=st.lists(st.tuples(st.integers(0, 5000), st.integers(0, 255)), max_size=8), cut=st.integers(0, 300))
@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
@pytest.mark.parametrize("name", ["a.tdms", "a.lvm", "a.xdf", "a.bag"])
def test_a_damaged_file_loads_or_is_rejected(
    tmp_path: Path, name: str, changes: list[tuple[int, int]], cut: int
) -> None:
    path = tmp_path / name
    path.unlink(missing_ok=True)
    FILES[name][0](path)
    check_damaged(path, changes, cut)
