"""LZF decompression, compiled: a loop over bytes."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tubepose.compiled import compiler

compiled = compiler((Path(__file__),))


@compiled
def expand(packed, size):
    """Bytes that LZF packed (liblzf's format): runs of literals, and copies of up to 264 bytes at most 8192 back.

    Args:
        packed: Array of shape (N,), uint8.
        size: Bytes that must come out.

    Returns:
        Array of shape (M,), uint8; M is smaller than `size` where the packed bytes break off or point before the start.
    """
    out = np.empty(size, np.uint8)
    i = o = np.int64(0)
    while i < len(packed):
        control = np.int64(packed[i])
        i += 1
        if control < 32:
            run = control + 1
            if i + run > len(packed) or o + run > size:
                return out[:o]
            for k in range(run):
                out[o + k] = packed[i + k]
            i += run
            o += run
            continue
        length = control >> 5
        if length == 7:
            if i >= len(packed):
                return out[:o]
            length += np.int64(packed[i])
            i += 1
        if i >= len(packed):
            return out[:o]
        start = o - ((control & 31) << 8) - np.int64(packed[i]) - 1
        i += 1
        length += 2
        if start < 0 or o + length > size:
            return out[:o]
        for k in range(length):
            out[o + k] = out[start + k]
        o += length
    return out[:o]
