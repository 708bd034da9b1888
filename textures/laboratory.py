"""Reads the files of laboratory programs: LabVIEW's TDMS and LVM, XDF of the Lab Streaming Layer, bags of ROS."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vibrocast import extras
from vibrocast.memory import shortage
from vibrocast.textures import arrays
from vibrocast.textures.columns import Table
from vibrocast.textures.recording import TextureError, spelt

Column = tuple[str, str | None, NDArray[Any]]
"""Name, unit as the file states it, and numbers (n,)."""

# By message type of ROS: where the x, y and z of a message lie, and their unit.
_VECTORS = {
    "sensor_msgs/msg/Imu": ("linear_acceleration", "m/s^2"),
    "geometry_msgs/msg/AccelStamped": ("accel.linear", "m/s^2"),
    "geometry_msgs/msg/Vector3Stamped": ("vector", None),
}


def is_ros_folder(path: Path) -> bool:
    """Return whether a folder is a bag of ROS 2."""
    return (path / "metadata.yaml").is_file()


def read(path: Path, key: str | None, rate_hz: float | None) -> Table:
    """Read a file of one of SUFFIXES, or the folder of a bag of ROS 2; `rate_hz` does not matter yet.

    `key` names a group or one channel ("group/channel") of TDMS, a segment of LVM by number, a stream of XDF, and a
    topic of ROS. Raises TextureError, OSError, and MissingExtraError without the extra [formats].
    """
    suffix = ".bag" if path.is_dir() else path.suffix.lower()
    extras.require("formats", _MODULES[suffix])
    with arrays.parsing(path, f"a {suffix} file"):
        return SUFFIXES[suffix](path, key)


def _read_tdms(path: Path, key: str | None) -> Table:
    from nptdms import TdmsFile

    with TdmsFile.open(path) as file:
        groups: dict[str, list[Any]] = {}
        for group in file.groups():
            channels = [channel for channel in group.channels() if channel.dtype.kind in "iuf" and len(channel)]
            groups |= {group.name: channels} if channels else {}
            groups |= {f"{group.name}/{channel.name}": [channel] for channel in channels}
        names = [name for name, channels in groups.items() if channels[0].group_name == name]
        chosen = groups[key] if key in groups else groups[arrays.chosen_key(names, key, path)]
        _reject_too_large(8 * sum(map(len, chosen)), path)
        steps = {float(each.properties.get("wf_increment", 0.0)) for each in chosen}
        columns = [(each.name, each.properties.get("unit_string"), each[:]) for each in chosen]
        return _table(columns, steps, path)


def _read_lvm(path: Path, key: str | None) -> Table:
    import lvm_read

    # Its `read` would unpickle a file next to this one.
    _reject_too_large(path.stat().st_size, path)
    told = lvm_read.read_str(path.read_text(encoding="utf-8", errors="ignore"))
    segments = {str(number): told[number] for number in range(told["Segments"])}
    segment = segments[arrays.chosen_key(list(segments), key, path)]
    units = iter(segment.get("Y_Unit_Label", ()))
    columns: list[Column] = []
    steps = {step for step in segment.get("Delta_X", ()) if step > 0}  # not one of comments, nan
    for name, values in zip(segment["Channel names"], segment["data"].T, strict=False):  # comments may be missing
        if name == "X_Value" and steps:
            continue  # the steps state the rate
        if name == "X_Value":
            columns.append(("time", "s", values))
        elif name != "Comment":
            columns.append((name, next(units, None), values))
    return _table(columns, steps, path)


def _read_xdf(path: Path, key: str | None) -> Table:
    import pyxdf

    _reject_too_large(path.stat().st_size, path)  # all of its streams are read
    streams, _ = pyxdf.load_xdf(str(path))
    signals = {stream["info"]["name"][0]: stream for stream in streams if isinstance(stream["time_series"], np.ndarray)}
    stream = signals[arrays.chosen_key(list(signals), key, path)]
    values, nominal_hz = stream["time_series"], float(stream["info"]["nominal_srate"][0])
    labels = [(f"channel {number + 1}", None) for number in range(values.shape[1])]
    description = stream["info"]["desc"][0]
    if description and description.get("channels") and description["channels"][0]:
        stated = description["channels"][0]["channel"]
        if len(stated) == values.shape[1]:
            labels = [(each.get("label", [""])[0], each.get("unit", [None])[0]) for each in stated]
    columns: list[Column] = [(name, unit, values[:, number]) for number, (name, unit) in enumerate(labels)]
    if not nominal_hz:
        columns.insert(0, ("time", "s", stream["time_stamps"] - stream["time_stamps"][0]))
    return _table(columns, {1 / nominal_hz if nominal_hz else 0.0}, path)


def _read_bag(path: Path, key: str | None) -> Table:
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    with AnyReader([path], default_typestore=get_typestore(Stores.LATEST)) as reader:
        topics = {name: topic for name, topic in reader.topics.items() if topic.msgtype in _VECTORS}
        others = {
            name: f"a {topic.msgtype or 'mixture'}" for name, topic in reader.topics.items() if name not in topics
        }
        chosen = topics[arrays.chosen_key(list(topics), key, path, others)]
        _reject_too_large(8 * 4 * chosen.msgcount, path)
        place, unit = _VECTORS[str(chosen.msgtype)]
        rows = np.array(list(_vectors(reader, chosen.connections, place))).reshape(-1, 4)
    columns: list[Column] = [("time", "s", rows[:, 0] - rows[:1, 0].sum())]
    columns += [(axis, unit, rows[:, number]) for number, axis in enumerate("xyz", start=1)]
    return _table(columns, {0.0}, path)


def _vectors(reader: Any, connections: Any, place: str) -> Iterator[tuple[float, float, float, float]]:
    """Yield time in s, x, y and z of each message."""
    start: int | None = None
    for connection, _, data in reader.messages(connections=connections):
        message = reader.deserialize(data, connection.msgtype)
        stamp = message.header.stamp
        # Nanoseconds since 1970 do not fit into a float64.
        time_ns = stamp.sec * 10**9 + stamp.nanosec
        start = time_ns if start is None else start
        for name in place.split("."):
            message = getattr(message, name)
        yield (time_ns - start) / 1e9, message.x, message.y, message.z


def _table(columns: list[Column], steps_s: set[float], path: Path) -> Table:
    """Return columns as a table; `steps_s`: between samples, 0 where the file states none. Raises TextureError."""
    lengths = {len(values) for _, _, values in columns}
    if len(lengths) > 1 or len(steps_s) > 1:
        listed = ", ".join(name for name, _, _ in columns)
        raise TextureError(
            f"{path}: channels of several rates or lengths; choose one of {listed} with `key`", parameter="key"
        )
    units = tuple(unit and (spelt(unit) or unit) for _, unit, _ in columns)
    values = np.column_stack([np.asarray(each, np.float64) for _, _, each in columns])
    step_s = next(iter(steps_s), 0.0)
    names = tuple(name for name, _, _ in columns)
    return Table(values, names, units, None, 1 / step_s if step_s > 0 else None)


def _reject_too_large(stated_bytes: int, path: Path) -> None:
    if lack := shortage(stated_bytes):
        raise TextureError(f"{path}: {lack}")


SUFFIXES: dict[str, Callable[[Path, str | None], Table]] = {
    ".tdms": _read_tdms,
    ".lvm": _read_lvm,
    ".xdf": _read_xdf,
    ".bag": _read_bag,
}
"""Readers by suffix."""
_MODULES = {".tdms": "nptdms", ".lvm": "lvm_read", ".xdf": "pyxdf", ".bag": "rosbags"}
