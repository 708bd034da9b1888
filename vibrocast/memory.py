"""Finds how much memory is free, to reject data that cannot fit before reading it."""

from collections.abc import Iterator
from pathlib import Path

CONTROL_GROUPS = Path("/sys/fs/cgroup")
GROUPS_OF_PROCESS = Path("/proc/self/cgroup")
MAX_EXPANSION = 1100
"""Most bytes that one byte of a file stands for. Deflate reaches 1032 ("zlib Technical Details", zlib.net)."""
PIPELINE_FACTOR = 10
"""How many times its own memory what is read takes to the end: float64 samples from `load` to `encode`, the most."""
limit_bytes: int | None = None
"""Most that this process may take, where another one has started it; None = what the machine has."""
_SMALL_BYTES = 2**20
_GIB = 2**30


def available_bytes() -> int:
    """Return how much memory a program may still take: free, in caches, within the limit of its control group."""
    import psutil

    free_bytes = min(int(psutil.virtual_memory().available), *_left_in_control_groups())
    return free_bytes if limit_bytes is None else min(free_bytes, limit_bytes)


def shortage(stated_bytes: int) -> str | None:
    """Return the end of an error whose subject has this size, if PIPELINE_FACTOR times as much is not free."""
    free_bytes, needed_bytes = available_bytes(), PIPELINE_FACTOR * stated_bytes
    if needed_bytes <= free_bytes:
        return None
    return (
        f"needs {needed_bytes / _GIB:.3g} GiB of memory, and only {free_bytes / _GIB:.3g} GiB are free; close other "
        "programs, or cut it into parts"
    )


def excess(stated_bytes: int, stored_bytes: int) -> str | None:
    """Return the end of an error whose subject, by the file, has more bytes than the stored ones can stand for."""
    if stated_bytes <= _SMALL_BYTES + MAX_EXPANSION * stored_bytes:
        return None
    return f"stands for {stated_bytes / _GIB:.3g} GiB, and the file holds {stored_bytes} bytes of it; save it again"


def _left_in_control_groups() -> Iterator[int]:
    """Yield the bytes that Linux's control groups, of version 2 and 1, leave; caches count as free."""
    yield 2**63
    try:
        lines = GROUPS_OF_PROCESS.read_text().splitlines()
    except OSError:
        return  # not Linux
    for line in lines:
        number, controllers, group = line.split(":", 2)
        if number == "0":
            root, limit_name, used_name = CONTROL_GROUPS, "memory.max", "anon"
        elif "memory" in controllers.split(","):
            root, limit_name, used_name = CONTROL_GROUPS / "memory", "memory.limit_in_bytes", "total_rss"
        else:
            continue
        # Inside a container, the program's own group may be mounted as the root.
        for folder in (root, root / group.lstrip("/")):
            try:
                limit_bytes = int((folder / limit_name).read_text())
                statistics = dict(item.split() for item in (folder / "memory.stat").read_text().splitlines())
                yield limit_bytes - int(statistics[used_name])
            except (OSError, ValueError, KeyError):
                continue  # no such group, or "max": no limit
