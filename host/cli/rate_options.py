"""The options of rate-controlled streams, of files coded as such and of live ones: what is to be held."""

from typing import Any

import click

from vibrocast.codec import rate_controlled
from vibrocast.host.cli.options import POSITIVE, Finite, options

rate_controlled_options = options(
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


def rate_target_of(choices: dict[str, Any]) -> rate_controlled.RateTarget | None:
    """Take the options of a rate-controlled stream out of all choices, None where none is asked. Raises
    click.UsageError.
    """
    rates = {name: choices.pop(name) for name in ("constant_rate_bps", "capped_rate_bps")}
    constant_quality = choices.pop("constant_quality")
    details = {name: choices.pop(name) for name in ("error_db", "rate_buffer_s", "packet_ms", "equal_error")}
    kinds = {**rates, "constant_quality": constant_quality or None}
    given = [option_of(name) for name, value in kinds.items() if value is not None]
    if not given:
        if useless := [name for name, value in details.items() if value not in (None, False)]:
            raise click.UsageError(f"{option_of(useless[0])} needs one of {', '.join(map(option_of, kinds))}.")
        return None
    if len(given) > 1 or choices["rate_bps"] is not None:
        others = ", ".join(map(option_of, [*kinds, "rate_bps"]))
        raise click.UsageError(f"{others} exclude each other: give one of them.")
    qualities = sum(value is not None for value in (choices["snr_db"], details["error_db"]))
    if rates["constant_rate_bps"] is not None and qualities:
        raise click.UsageError("a constant rate leaves no quality to ask for: drop it, or give --capped-rate-bps.")
    if rates["constant_rate_bps"] is None and qualities != 1:
        raise click.UsageError(f"{given[0]} needs either --snr-db or --error-db.")
    if constant_quality and details["rate_buffer_s"] is not None:
        raise click.UsageError("--rate-buffer-s belongs to a rate: drop it.")
    packet_ms = details.pop("packet_ms")
    packet_s = None if packet_ms is None else packet_ms / 1000
    return rate_controlled.RateTarget(snr_db=choices["snr_db"], packet_s=packet_s, **rates, **details)


def option_of(name: str) -> str:
    """Return an option as it is given."""
    return f"--{name.replace('_', '-')}"
