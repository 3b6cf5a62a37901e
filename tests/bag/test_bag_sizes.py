"""What a file claims is bounded before memory is taken for it."""

from __future__ import annotations

import struct

import pytest
import zstandard

from dopslam_ros.bag.records import Cursor, DamagedError, salvage_chunk, unpack_chunk

CLAIMED = 5000


def chunk(packed: bytes, claimed: int, length: int) -> Cursor:
    """The content of a chunk record, compressed with zstd, that claims a size."""
    header = struct.pack("<QQQI", 0, 0, claimed, 0) + struct.pack("<I", 4) + b"zstd"
    return Cursor(header + struct.pack("<Q", length) + packed)


def test_a_chunk_that_swells_is_not_unpacked() -> None:
    """Kilobytes that would become hundreds of megabytes: refused, or cut off where it said."""
    packed = zstandard.ZstdCompressor(write_content_size=False).compress(bytes(200_000_000))
    assert len(packed) < 10_000
    with pytest.raises(DamagedError):
        unpack_chunk(chunk(packed, CLAIMED, len(packed)))
    kept = salvage_chunk(chunk(packed[:-1], CLAIMED, len(packed)))
    assert kept == bytes(CLAIMED)


@pytest.mark.parametrize("claimed", [1 << 40, (1 << 64) - 1])
def test_a_chunk_that_claims_too_much_is_refused(claimed: int) -> None:
    """No memory is taken for a size that no chunk has."""
    packed = zstandard.ZstdCompressor().compress(bytes(100))
    for cut in (0, 1):
        with pytest.raises(DamagedError):
            salvage_chunk(chunk(packed[: len(packed) - cut], claimed, len(packed)))
