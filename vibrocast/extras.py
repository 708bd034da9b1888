"""Extras: which optional packages each brings, and the command that installs one."""

import sys
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

from vibrocast.errors import BAD_INPUT, VibrocastError

# By module; the smallest extra first. pyproject.toml says what each package is for.
EXTRAS = {
    "av": ("peers", "bench"),
    "bjontegaard": ("bench",),
    "capstone": ("firmware",),
    "cryptography": ("keys",),
    "distributed": ("bench",),
    "elftools": ("firmware",),
    "jinja2": ("plan", "bench", "study"),
    "matplotlib": ("plot", "bench", "study", "train"),
    "lvm_read": ("formats",),
    "matio": ("formats",),
    "miniaudio": ("audio",),
    "nptdms": ("formats",),
    "onnx": ("train",),
    "pebble": ("bench", "train"),
    "polars": ("bench",),
    "pytest": ("bench",),
    "pylsl": ("lab",),
    "pythonosc": ("lab",),
    "pyxdf": ("formats",),
    "rosbags": ("formats",),
    "statsmodels": ("study",),
    "torch": ("train",),
    "unicorn": ("firmware",),
    "vibromaf": ("plan", "bench"),
    "ziglang": ("firmware",),
}


class MissingExtraError(VibrocastError, ImportError):
    """A package of an extra is not installed; the message says how to install the extra."""

    exit_code = BAD_INPUT


def require(extra: str, *modules: str) -> None:
    """Raise MissingExtraError if modules of an extra are not installed; without names, all its modules count."""
    if missing := _missing(extra, modules):
        raise MissingExtraError(_advice(missing, extra))


def advice(extra: str) -> str | None:
    """Return the line that says how to install an extra; None if all of its modules are installed."""
    missing = _missing(extra)
    return _advice(missing, extra) if missing else None


def explained(error: ModuleNotFoundError) -> MissingExtraError | None:
    """Return the error that says how to install a missing module; None if no extra brings it."""
    module = (error.name or "").partition(".")[0]
    return MissingExtraError(_advice([module], EXTRAS[module][0])) if module in EXTRAS else None


def _missing(extra: str, modules: Sequence[str] = ()) -> list[str]:
    wanted = modules or [module for module, bringing in EXTRAS.items() if extra in bringing]
    return [module for module in wanted if find_spec(module) is None]


def _advice(missing: Sequence[str], extra: str) -> str:
    return f"this needs {', '.join(missing)}; install the extra [{extra}]: {install_command(extra)}"


def install_command(extra: str) -> str:
    """Return the command that adds an extra to this installation, from where vibrocast was installed."""
    import shlex
    import shutil
    import subprocess

    python = "python" if shutil.which("python") == sys.executable else sys.executable
    requirement = _requirement(extra)
    command = [python, "-m", "pip", "install", *(requirement or [f".[{extra}]"])]
    text = subprocess.list2cmdline(command) if sys.platform == "win32" else shlex.join(command)
    # vibrocast is on no package index: its name alone would find nothing, or another package.
    return text if requirement else f"in vibrocast's sources, {text}"


def _requirement(extra: str) -> list[str]:
    """Return the arguments of pip that name vibrocast's folder or archive with an extra; empty if pip noted neither."""
    # Only an error needs these modules, which load as slowly as all of `vibrocast --help`.
    import json
    from importlib.metadata import PackageNotFoundError, distribution
    from urllib.parse import urlsplit
    from urllib.request import url2pathname

    try:
        origin = json.loads(distribution("vibrocast").read_text("direct_url.json") or "{}")
    except PackageNotFoundError:  # a checkout on the path
        return ["-e", f"{Path(__file__).resolve().parents[1]}[{extra}]"]
    url = origin.get("url", "")
    if "dir_info" in origin:
        editable = ["-e"] if origin["dir_info"].get("editable") else []
        return [*editable, f"{url2pathname(urlsplit(url).path)}[{extra}]"]
    if "vcs_info" in origin:
        url = f"{origin['vcs_info']['vcs']}+{url}@{origin['vcs_info']['commit_id']}"
    return [f"vibrocast[{extra}] @ {url}"] if url else []
