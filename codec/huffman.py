"""Canonical Huffman codes: lengths from counts, codes from lengths, and packing of codes into bytes."""

import heapq
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

MAX_CODE = 15


def code_lengths(counts: Sequence[int]) -> list[int]:
    """Return the length of each symbol's code in bits, at most MAX_CODE; 0 for a symbol that does not occur.

    D. Huffman, "A method for the construction of minimum-redundancy codes", Proc. IRE 40 (1952). The code is complete:
    if only one symbol occurs, a second one gets a code too. While a code is too long, the counts are halved, as in
    bzip2.
    """
    shared = list(counts)
    while sum(count > 0 for count in shared) < 2:
        shared[shared.index(0)] = 1
    while True:
        lengths = [0] * len(shared)
        heap: list[tuple[int, tuple[int, ...]]] = [
            (count, (symbol,)) for symbol, count in enumerate(shared) if count > 0
        ]
        heapq.heapify(heap)
        while len(heap) > 1:
            (first, left), (second, right) = heapq.heappop(heap), heapq.heappop(heap)
            for symbol in left + right:
                lengths[symbol] += 1
            heapq.heappush(heap, (first + second, left + right))
        if max(lengths) <= MAX_CODE:
            return lengths
        shared = [(count + 1) // 2 for count in shared]


def canonical_codes(lengths: Sequence[int]) -> list[int]:
    """Return the code of each symbol: numbers in order of length, then of symbol; 0 for a symbol without a code."""
    codes = [0] * len(lengths)
    code = previous = 0
    for length, symbol in sorted((length, symbol) for symbol, length in enumerate(lengths) if length):
        code <<= length - previous
        codes[symbol] = code
        code, previous = code + 1, length
    return codes


def pack_bits(words: NDArray[np.int64], lengths: NDArray[np.int64]) -> bytes:
    """Join words of these lengths in bits, each from its highest bit on; zeros fill the last byte."""
    ends = np.cumsum(lengths)
    shifts = np.repeat(ends, lengths) - 1 - np.arange(ends[-1] if len(ends) else 0)
    return np.packbits((np.repeat(words, lengths) >> shifts & 1).astype(np.uint8)).tobytes()
