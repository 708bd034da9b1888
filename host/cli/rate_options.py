"""The options of rate-controlled streams, both in files and live."""

from dataclasses import dataclass

import click

from vibrocast.codec import rate_controlled
from vibrocast.codec.rate_control import DEFAULT_RATE_BUFFER_S
from vibrocast.host.cli.option_types import Number, positive
from vibrocast.host.cli.options import grouped
from vibrocast.host.cli.sections import RATE_CONTROL, section


@dataclass(frozen=True)
class RateOptions:
    """The target of a rate-controlled stream: one of the first two, and how it is held."""

    constant_rate_bps: float | None
    capped_rate_bps: float | None
    error_db: float | None
    rate_buffer_s: float | None
    packet_ms: float | None
    equal_error: bool

    @property
    def packet_s(self) -> float | None:
        """Duration of packets in s; None = not given."""
        return None if self.packet_ms is None else self.packet_ms / 1000

    def target(self, snr_db: float | None, rate_bps: float | None = None) -> rate_controlled.RateTarget | None:
        """Return the target, None where no rate control is required. Raises click.UsageError.

        `snr_db`, `rate_bps`: the options of these names, which another group has.
        """
        kinds = {"constant_rate_bps": self.constant_rate_bps, "capped_rate_bps": self.capped_rate_bps}
        given = [option_of(name) for name, value in kinds.items() if value is not None]
        if not given:
            for name in ("error_db", "rate_buffer_s", "equal_error"):
                if getattr(self, name) not in (None, False):
                    policies = ", ".join(map(option_of, kinds))
                    raise click.UsageError(f"{option_of(name)} is for rate control; add one of {policies}")
            return None
        if len(given) > 1 or rate_bps is not None:
            others = ", ".join(map(option_of, [*kinds, "rate_bps"]))
            raise click.UsageError(f"{others} exclude each other; give one of them")
        qualities = sum(value is not None for value in (snr_db, self.error_db))
        if self.constant_rate_bps is not None and qualities:
            raise click.UsageError(
                "a constant rate sets the quality itself; drop --snr-db and --error-db, or give --capped-rate-bps"
            )
        if self.constant_rate_bps is None and qualities != 1:
            raise click.UsageError(f"{given[0]} needs a quality; give either --snr-db or --error-db")
        return rate_controlled.RateTarget(
            constant_rate_bps=self.constant_rate_bps,
            capped_rate_bps=self.capped_rate_bps,
            snr_db=snr_db,
            error_db=self.error_db,
            rate_buffer_s=self.rate_buffer_s,
            packet_s=self.packet_s,
            equal_error=self.equal_error,
        )


def option_of(name: str) -> str:
    """Return an option as it is given."""
    return f"--{name.replace('_', '-')}"


rate_controlled_options = section(
    RATE_CONTROL,
    grouped(
        "rate",
        RateOptions,
        click.option(
            "--constant-rate-bps",
            type=positive("bit/s"),
            help="Hold this rate within 1 % over any 2 s, framing included.",
        ),
        click.option(
            "--capped-rate-bps",
            type=positive("bit/s"),
            help="Hold --snr-db or --error-db up to this rate, framing included.",
        ),
        click.option(
            "--error-db", type=Number("dB"), help="Set the level of the error relative to the detection threshold."
        ),
        click.option(
            "--rate-buffer-s",
            type=positive("s"),
            help="Set the rate buffer; longer evens the quality, and varies the rate. "
            f"Default: {DEFAULT_RATE_BUFFER_S:g}.",
        ),
        click.option(
            "--packet-ms",
            type=positive("ms"),
            help="Set the duration of packets. Default: 60 bytes at the rate; "
            "without rate control, a file has the fewest bytes.",
        ),
        click.option("--equal-error", is_flag=True, help="Give all channels equal error, instead of equal SNR."),
    ),
)
