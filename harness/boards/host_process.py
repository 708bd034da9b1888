"""The controller's firmware as a process of this machine, behind its own pseudo-terminal."""

import subprocess
from collections.abc import Sequence
from pathlib import Path

from vibrocast.device_protocol.transports import Closing, TransportError
from vibrocast.firmware.build import build
from vibrocast.host.devices import FirmwareDevice


class HostProcess(Closing):
    """Runs the firmware built for `host`; a context manager. `name`: the serial port that a host program opens.

    `options`: of the program firmware/ports/host/main.c. `public_key`, `verifier`, `actuator`: as for `build`. Raises
    BuildError, and TransportError if the program does not start.
    """

    def __init__(
        self,
        *options: str | Path,
        public_key: bytes | None = None,
        verifier: Sequence[Path] = (),
        actuator: Path | None = None,
    ) -> None:
        # The process ends with its input, so nothing outlives a host program that is killed.
        self._process = subprocess.Popen(
            [build("host", public_key=public_key, verifier=verifier, actuator=actuator), *options],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        assert self._process.stdout is not None
        self.name = self._process.stdout.readline().rstrip("\n")
        if not self.name:
            _, errors = self._process.communicate()
            raise TransportError(f"the controller's process did not start: {errors.strip()}")

    def close(self) -> None:
        """End the process; may be called again. Raises TransportError if it failed."""
        try:
            _, errors = self._process.communicate()
        except ValueError:
            return
        if self._process.returncode != 0:
            raise TransportError(f"the controller's process failed: {errors.strip() or self._process.returncode}")


DEVICE = FirmwareDevice(summary="the firmware as a process of this machine", process=HostProcess, channels=8)
"""The address `host`."""
