"""What the live nodes said about themselves, as far as the bag has it."""

from __future__ import annotations

from typing import Any

from dopslam_ros.bag import BagReader, BagTypeError, deserialize
from dopslam_ros.messages import topics

Reports = dict[str, list[tuple[str, str]]]


def last_reports(reader: BagReader) -> Reports:
    """The last values of each node on /diagnostics.

    Raises:
        BagError: the bag cannot be read.
    """
    found: Reports = {}
    for message in reader.messages({topics.DIAGNOSTICS.name}):
        try:
            content: Any = deserialize(message.payload, topics.DIAGNOSTICS.type_name)
        except BagTypeError:
            continue  # the replay counts what is malformed among its inputs; this is none
        for status in content.status:
            values = [(str(item.key), str(item.value)) for item in status.values]
            found[str(status.name)] = [("says", str(status.message)), *values]
    return found
