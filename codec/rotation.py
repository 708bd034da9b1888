"""Rotation of the channels of `mdct`: its section of a configuration, and the encoder's choice of it."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise

import numpy as np

from vibrocast.codec.interface import CodecError, Signal

EDGES = (0, 4, 12, 28, 64)
"""Coefficients at which the bands begin and end, at a hop of 64."""
BANDS = len(EDGES) - 1
ANGLES = 64
"""Codes of angles, in half a turn."""
MAX_DELAY = 63
"""Longest delay of a channel in samples."""
MAX_SECTION_BYTES = 160
"""Longest section that the encoder chooses: with the steps of 16 channels, it fits a stream header."""
IDENTITY, COMMON, OWN = range(3)
"""States of a band."""

_DELAY_BITS, _STATE_BITS, _ANGLE_BITS = 6, 2, 6
_DISTORTION = 0.25
"""Noise power at which bits are estimated, relative to the mean power of the coefficients. About 6 dB of SNR."""
_SIGNIFICANT = 0.2
"""Least correlation of two channels from which a delay between them is taken: unrelated textures stay below."""
_BETTER = 1.05
"""How much better a delay correlates two channels than none, at least."""

Angles = tuple[int, ...]


@dataclass(frozen=True)
class Rotation:
    """How coded channels become output channels.

    `delays`: of each output channel, in samples. `states`: of each band. `common`: angle codes of the bands with the
    state COMMON, one for each pair of channels; empty where no band has it. `own`: those of each band with the state
    OWN.
    """

    delays: tuple[int, ...]
    states: tuple[int, ...]
    common: Angles
    own: tuple[Angles, ...]

    @property
    def channels(self) -> int:
        """Channels in the stream."""
        return len(self.delays)

    @property
    def delay_samples(self) -> int:
        """The delay of all channels together, in samples."""
        return max(self.delays)

    def pack(self) -> bytes:
        """Return the section; docs/reference/bitstream.md has its layout."""
        fields = [(delay, _DELAY_BITS) for delay in self.delays]
        fields += [(state, _STATE_BITS) for state in self.states]
        fields += [(angle, _ANGLE_BITS) for angles in (self.common, *self.own) for angle in angles]
        bits = "".join(f"{value:0{count}b}" for value, count in fields)
        bits += "0" * (-len(bits) % 8)
        return int(bits, 2).to_bytes(len(bits) // 8, "big")

    @classmethod
    def unpack(cls, section: bytes, channels: int) -> "Rotation":
        """Read a section. Raises CodecError where it is not valid."""
        error = CodecError(
            f"the rotation {section.hex()!r} does not fit {channels} channels; give auto, or the one of another stream"
        )
        bits = "".join(f"{byte:08b}" for byte in section)
        pairs = channels * (channels - 1) // 2
        head = _DELAY_BITS * channels + _STATE_BITS * BANDS
        if channels < 2 or len(bits) < head:
            raise error
        delays = _numbers(bits[: _DELAY_BITS * channels], _DELAY_BITS)
        states = _numbers(bits[_DELAY_BITS * channels : head], _STATE_BITS)
        matrices = states.count(OWN) + (COMMON in states)
        end = head + matrices * pairs * _ANGLE_BITS
        if not matrices or min(delays) > 0 or max(states) > OWN or len(bits) != end + -end % 8 or "1" in bits[end:]:
            raise error
        angles = _numbers(bits[head:end], _ANGLE_BITS)
        each = [angles[start : start + pairs] for start in range(0, len(angles), pairs)]
        common = each.pop(0) if COMMON in states else ()
        return cls(delays, states, common, tuple(each))

    def matrices(self) -> list[Signal]:
        """Return the matrix of each band (channels, channels): row = output channel, column = coded channel."""
        own = iter(self.own)
        angles = [next(own) if state == OWN else self.common if state == COMMON else () for state in self.states]
        return [matrix(each, self.channels) for each in angles]

    def coded(self, spectra: Signal) -> Signal:
        """Return the coded channels of spectra (blocks, channels, hop) of aligned channels in units of their steps."""
        hop = spectra.shape[2]
        parts = [
            np.einsum("ij,bik->bjk", each, spectra[:, :, band])
            for each, band in zip(self.matrices(), bands(hop), strict=True)
        ]
        return np.concatenate(parts, axis=2)


def bands(hop: int) -> Iterator[slice]:
    """Yield the coefficients of each band at a hop."""
    for start, stop in pairwise(EDGES):
        yield slice(start * hop // 64, stop * hop // 64)


def matrix(angles: Sequence[int], channels: int) -> Signal:
    """Return the product of Givens rotations, one for each pair of channels; the identity without angles."""
    product = np.eye(channels)
    pairs = combinations(range(channels if angles else 0), 2)
    for (first, second), angle in zip(pairs, angles, strict=True):
        product[:, [first, second]] = product[:, [first, second]] @ _givens(angle)
    return product


def angles_of(target: Signal) -> Angles:
    """Return the angle codes whose product is nearest to an orthogonal matrix, but for the signs of its columns.

    Each rotation clears an element below the diagonal, as in a QR decomposition (Golub and Van Loan, Matrix
    Computations, 4th ed., 5.2.5). The next ones start from the rotation that was rounded.
    """
    left = target.copy()
    codes = []
    for first, second in combinations(range(len(target)), 2):
        turn = np.arctan2(-left[second, first], left[first, first])
        codes.append(round(turn * ANGLES / np.pi) % ANGLES)
        left[[first, second]] = _givens(codes[-1]).T @ left[[first, second]]
    return tuple(codes)


def aligned(samples: Signal, delays: Sequence[int]) -> Signal:
    """Return samples (n, channels) without the first max(delays), each channel late by as much as it is not delayed."""
    longest = max(delays)
    stop = len(samples) - longest
    return np.stack([samples[delay : delay + stop, channel] for channel, delay in enumerate(delays)], axis=1)


def candidates(normalised: Signal, hop: int, analyse: Callable[[Signal], Signal]) -> list[Rotation]:
    """Return the rotation without delays that saves the most bits by estimate, then the one with delays, if they do.

    `normalised`: samples (n, channels) relative to each channel's RMS value. `analyse`: returns the spectra (blocks,
    channels, hop) of samples.
    """
    found = []
    for delays in dict.fromkeys([(0,) * normalised.shape[1], find_delays(normalised)]):
        gated = [
            (saved_bits, rotation)
            for saved_bits, rotation in _gated(analyse(aligned(normalised, delays)), hop, delays)
            if saved_bits > 0 and len(rotation.pack()) <= MAX_SECTION_BYTES
        ]
        found += [rotation for _, rotation in sorted(gated, key=lambda each: -each[0])[:1]]
    return found


def find_delays(samples: Signal) -> tuple[int, ...]:
    """Return the delay of each channel (n, channels) behind the first to hear a wave, in samples.

    Pairs of channels are linked by the delay of their largest cross-correlation, the strongest links first.
    """
    channels = samples.shape[1]
    power = np.sqrt(np.sum(np.square(samples), axis=0))
    unit = samples / np.where(power > 0, power, 1.0)
    size = 1 << (len(samples) + MAX_DELAY - 1).bit_length()
    spectra = np.fft.rfft(unit, size, axis=0)
    links = []
    for first, second in combinations(range(channels), 2):
        every = np.abs(np.fft.irfft(spectra[:, first].conj() * spectra[:, second], size))
        around = np.concatenate([every[-MAX_DELAY:], every[: MAX_DELAY + 1]])
        lag = int(np.argmax(around)) - MAX_DELAY
        if around[lag + MAX_DELAY] < _BETTER * around[MAX_DELAY]:
            lag = 0
        links.append((float(around[lag + MAX_DELAY]), first, second, lag))
    groups = [{channel: 0} for channel in range(channels)]
    for strength, first, second, lag in sorted(links, reverse=True):
        one, other = (next(group for group in groups if channel in group) for channel in (first, second))
        if one is other or strength < _SIGNIFICANT:
            continue
        shift = one[first] + lag - other[second]
        joined = one | {channel: place + shift for channel, place in other.items()}
        if max(joined.values()) - min(joined.values()) <= MAX_DELAY:
            groups = [group for group in groups if group not in (one, other)] + [joined]
    delays = {channel: place - min(group.values()) for group in groups for channel, place in group.items()}
    return tuple(delays[channel] for channel in range(channels))


def _gated(spectra: Signal, hop: int, delays: tuple[int, ...]) -> Iterator[tuple[float, Rotation]]:
    """Yield rotations with the states that take the fewest bits, behind the bits that they save."""
    channels = spectra.shape[1]
    angle_bits = _ANGLE_BITS * channels * (channels - 1) // 2
    head_bits = 8 + _DELAY_BITS * channels + _STATE_BITS * BANDS
    parts = [spectra[:, :, band] for band in bands(hop)]
    plain = [_bits(part).sum() for part in parts]
    own = [_principal(part) for part in parts]
    own_bits = [_rotated_bits(part, angles) + angle_bits for part, angles in zip(parts, own, strict=True)]
    common = _principal(spectra)
    common_bits = [_rotated_bits(part, common) for part in parts]
    for side_bits, choices in (
        (0, [(plain, IDENTITY), (own_bits, OWN)]),
        (angle_bits, [(plain, IDENTITY), (common_bits, COMMON), (own_bits, OWN)]),
        (angle_bits, [(plain, IDENTITY), (common_bits, COMMON)]),
    ):
        best = [min((bits[band], state) for bits, state in choices) for band in range(BANDS)]
        states = tuple(state for _, state in best)
        if any(states):
            kept = tuple(angles for angles, state in zip(own, states, strict=True) if state == OWN)
            rotation = Rotation(delays, states, common if COMMON in states else (), kept)
            yield sum(plain) - sum(bits for bits, _ in best) - side_bits - head_bits, rotation


def _principal(spectra: Signal) -> Angles:
    """Return the angles that turn spectra (blocks, channels, bins) into principal components, the largest first.

    Silent channels stay apart: whatever leaks into them would be heard.
    """
    covariance = np.einsum("bik,bjk->ij", spectra, spectra)
    heard = np.flatnonzero(np.diag(covariance) > 0)
    found = iter(angles_of(np.linalg.eigh(covariance[np.ix_(heard, heard)])[1][:, ::-1]))
    pairs = combinations(range(len(covariance)), 2)
    return tuple(next(found) if np.isin(pair, heard).all() else 0 for pair in pairs)


def _rotated_bits(spectra: Signal, angles: Angles) -> float:
    rotated = np.einsum("ij,bik->bjk", matrix(angles, spectra.shape[1]), spectra)
    return float(_bits(rotated).sum())


def _bits(spectra: Signal) -> Signal:
    """Return the estimated bits of each coefficient: those of a Gaussian value of its power above the noise."""
    bits: Signal = 0.5 * np.log2(1 + np.square(spectra) / _DISTORTION)
    return bits


def _givens(code: int) -> Signal:
    cosine, sine = np.cos(np.pi * code / ANGLES), np.sin(np.pi * code / ANGLES)
    return np.array([[cosine, sine], [-sine, cosine]])


def _numbers(bits: str, width: int) -> tuple[int, ...]:
    return tuple(int(bits[start : start + width], 2) for start in range(0, len(bits), width))
