"""Reading and writing rosbag2 bags in MCAP without a ROS installation.

The bags are those of ROS 2 Jazzy: ``ros2 bag`` and the usual viewers take them as their own.
"""

from dopslam_ros.bag.errors import (
    BagError,
    BagExistsError,
    BagFormatError,
    BagTypeError,
    BagWriteError,
)
from dopslam_ros.bag.qos import (
    INFINITE_NS,
    Durability,
    History,
    Liveliness,
    OfferedQos,
    Reliability,
    from_profile,
    from_yaml,
    to_yaml,
)
from dopslam_ros.bag.reader import BagMessage, BagReader, TopicInfo
from dopslam_ros.bag.typestore import (
    canonical,
    definition,
    deserialize,
    message_class,
    record_type,
    serialize,
    type_hash,
    typestore,
)
from dopslam_ros.bag.writer import BagWriter

__all__ = [
    "INFINITE_NS",
    "BagError",
    "BagExistsError",
    "BagFormatError",
    "BagMessage",
    "BagReader",
    "BagTypeError",
    "BagWriteError",
    "BagWriter",
    "Durability",
    "History",
    "Liveliness",
    "OfferedQos",
    "Reliability",
    "TopicInfo",
    "canonical",
    "definition",
    "deserialize",
    "from_profile",
    "from_yaml",
    "message_class",
    "record_type",
    "serialize",
    "to_yaml",
    "type_hash",
    "typestore",
]
