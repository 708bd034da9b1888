"""The options of rate-controlled streams, of files coded as such and of live ones: what is to be held."""

from dataclasses import dataclass

import click

from vibrocast.codec import rate_controlled
from vibrocast.host.cli.options import POSITIVE, Finite, grouped


@dataclass(frozen=True)
class RateOptions:
    """What a rate-controlled stream holds: one of the first three, and how."""

    constant_rate_bps: float | None
    capped_rate_bps: float | None
    constant_quality: bool
    error_db: float | None
    rate_buffer_s: float | None
    packet_ms: float | None
    equal_error: bool

    def target(self, snr_db: float | None, rate_bps: float | None = None) -> rate_controlled.RateTarget | None:
        """Return the target, None where no rate control is required. Raises click.UsageError.

        `snr_db`, `rate_bps`: the options of these names, which another group has.
        """
        kinds = {
            "constant_rate_bps": self.constant_rate_bps,
            "capped_rate_bps": self.capped_rate_bps,
            "constant_quality": self.constant_quality or None,
        }
        given = [option_of(name) for name, value in kinds.items() if value is not None]
        if not given:
            for name in ("error_db", "rate_buffer_s", "packet_ms", "equal_error"):
                if getattr(self, name) not in (None, False):
                    raise click.UsageError(f"{option_of(name)} needs one of {', '.join(map(option_of, kinds))}.")
            return None
        if len(given) > 1 or rate_bps is not None:
            others = ", ".join(map(option_of, [*kinds, "rate_bps"]))
            raise click.UsageError(f"{others} exclude each other: give one of them.")
        qualities = sum(value is not None for value in (snr_db, self.error_db))
        if self.constant_rate_bps is not None and qualities:
            raise click.UsageError("a constant rate leaves no quality to ask for: drop it, or give --capped-rate-bps.")
        if self.constant_rate_bps is None and qualities != 1:
            raise click.UsageError(f"{given[0]} needs either --snr-db or --error-db.")
        if self.constant_quality and self.rate_buffer_s is not None:
            raise click.UsageError("--rate-buffer-s belongs to a rate: drop it.")
        return rate_controlled.RateTarget(
            constant_rate_bps=self.constant_rate_bps,
            capped_rate_bps=self.capped_rate_bps,
            snr_db=snr_db,
            error_db=self.error_db,
            rate_buffer_s=self.rate_buffer_s,
            packet_s=None if self.packet_ms is None else self.packet_ms / 1000,
            equal_error=self.equal_error,
        )


def option_of(name: str) -> str:
    """Return an option as it is given."""
    return f"--{name.replace('_', '-')}"


rate_controlled_options = grouped(
    "rate",
    RateOptions,
    click.option(
        "--constant-rate-bps",
        type=POSITIVE,
        help="As a live stream: over any 2 s, so many bits per second in packets and their frames, within 1 %.",
    ),
    click.option(
        "--capped-rate-bps",
        type=POSITIVE,
        help="As a live stream: every packet at --snr-db or --error-db, but never more bits per second than these.",
    ),
    click.option("--constant-quality", is_flag=True, help="As a live stream: every packet at --snr-db or --error-db."),
    click.option(
        "--error-db", type=Finite(), help="Level of the error relative to the detection threshold, third octaves."
    ),
    click.option(
        "--rate-buffer-s", type=POSITIVE, help="Let a rate wander by so many seconds' bits, for a more even quality."
    ),
    click.option("--packet-ms", type=POSITIVE, help="Length of packets; if not given, the wire adds at most 15 %."),
    click.option("--equal-error", is_flag=True, help="The same error in all channels, rather than the same SNR."),
)
