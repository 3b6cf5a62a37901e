"""Landmarks as markers for RViz: a solid body and an ellipsoid each."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from dopslam_ros.core.linalg.arrays import FloatArray
from dopslam_ros.core.linalg.quantiles import chi_square
from dopslam_ros.core.pmb import LandmarkEstimates
from dopslam_ros.core.settings.layout import BS_ID, SPACE, LandmarkType
from dopslam_ros.messages import topics
from dopslam_ros.messages.common import (
    Types,
    make_header,
    make_point,
    make_quaternion,
    make_vector,
)

# The ellipsoids that are drawn hold the landmark with this probability.
ELLIPSOID_PROBABILITY = 0.95
_STDS = math.sqrt(float(chi_square(ELLIPSOID_PROBABILITY, SPACE)))
_ELLIPSOID_OPACITY = 0.25
# Of each axis the two others, in the order in which a rotation takes the first to the second.
_BEFORE, _AFTER = [1, 2, 0], [2, 0, 1]
_SPHERE, _DELETE = 2, 2


class Look(NamedTuple):
    """How a type of landmarks is drawn: shape of the body, its size [m], colour."""

    name: str
    shape: int
    size: float
    colour: tuple[float, float, float]


LOOKS = {
    int(LandmarkType.BS): Look("BS", 3, 4.0, (0.1, 0.1, 0.1)),
    int(LandmarkType.VA): Look("VA", 1, 3.0, (0.0, 0.45, 0.7)),
    int(LandmarkType.SP): Look("SP", _SPHERE, 2.0, (0.85, 0.37, 0.0)),
}


def _unused(types: Types) -> dict[str, Any]:
    """What every marker has and none uses."""
    return {
        "lifetime": types("builtin_interfaces/msg/Duration")(sec=0, nanosec=0),
        "frame_locked": False,
        "points": [],
        "colors": [],
        "texture_resource": "",
        "uv_coordinates": [],
        "text": "",
        "mesh_resource": "",
        "mesh_use_embedded_materials": False,
        "texture": types("sensor_msgs/msg/CompressedImage")(
            header=make_header(types, 0, ""), format="", data=np.zeros(0, np.uint8)
        ),
        "mesh_file": types("visualization_msgs/msg/MeshFile")(
            filename="", data=np.zeros(0, np.uint8)
        ),
    }


class Markers:
    """Turns maps into marker arrays; remembers what was shown, to delete it when it is gone.

    Args:
        types: finds message classes.
        bs: (3,) position of the BS [m].
    """

    def __init__(self, types: Types, bs: FloatArray) -> None:
        self._types = types
        self._shown: set[tuple[str, int]] = set()
        self._bs = make_point(types, tuple(map(float, bs)))
        self._upright = make_quaternion(types, (0.0, 0.0, 0.0, 1.0))
        self._sizes = {k: make_vector(types, (look.size,) * 3) for k, look in LOOKS.items()}
        self._tints = {k: _colour(types, look, _ELLIPSOID_OPACITY) for k, look in LOOKS.items()}
        self._unused = _unused(types)

    def of(self, header: Any, landmarks: LandmarkEstimates) -> Any:
        """A MarkerArray: a body and an ellipsoid per landmark; DELETE for what is gone."""
        types, bs = self._types, (LOOKS[LandmarkType.BS].name, BS_ID)
        markers, shown = [self._body(header, bs, LandmarkType.BS, self._bs, 1.0)], {bs}
        sizes, rotations = _ellipsoids(landmarks.covariances)
        for landmark, kind, position, existence, size, rotation in zip(
            landmarks.ids.tolist(),
            landmarks.types.tolist(),
            landmarks.positions.tolist(),
            landmarks.existence.tolist(),
            sizes.tolist(),
            rotations.tolist(),
            strict=True,
        ):
            name, point = LOOKS[kind].name, make_point(types, position)
            body, ellipsoid = (name, landmark), (f"{name}_ellipsoid", landmark)
            shown |= {body, ellipsoid}
            turned, diameters = make_quaternion(types, rotation), make_vector(types, size)
            tint = self._tints[kind]
            markers += [
                self._body(header, body, kind, point, existence),
                self._marker(header, ellipsoid, _SPHERE, point, turned, diameters, tint),
            ]
        markers += [self._deletion(header, key) for key in sorted(self._shown - shown)]
        self._shown = shown
        return types(topics.LANDMARK_MARKERS.type_name)(markers=markers)

    def _body(
        self, header: Any, key: tuple[str, int], kind: int, point: Any, existence: float
    ) -> Any:
        look, size = LOOKS[kind], self._sizes[kind]
        colour = _colour(self._types, look, existence)
        return self._marker(header, key, look.shape, point, self._upright, size, colour)

    def _deletion(self, header: Any, key: tuple[str, int]) -> Any:
        types = self._types
        nowhere, size = make_point(types, (0.0,) * 3), make_vector(types, (1.0,) * 3)
        colour = types("std_msgs/msg/ColorRGBA")(r=0.0, g=0.0, b=0.0, a=0.0)
        return self._marker(
            header, key, _SPHERE, nowhere, self._upright, size, colour, action=_DELETE
        )

    def _marker(
        self,
        header: Any,
        key: tuple[str, int],
        shape: int,
        point: Any,
        orientation: Any,
        size: Any,
        colour: Any,
        action: int = 0,
    ) -> Any:
        return self._types("visualization_msgs/msg/Marker")(
            header=header,
            ns=key[0],
            id=key[1],
            type=shape,
            action=action,
            pose=self._types("geometry_msgs/msg/Pose")(position=point, orientation=orientation),
            scale=size,
            color=colour,
            **self._unused,
        )


def _colour(types: Types, look: Look, opacity: float) -> Any:
    r, g, b = look.colour
    return types("std_msgs/msg/ColorRGBA")(r=r, g=g, b=b, a=opacity)


def _ellipsoids(covariances: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(L, 3) diameters [m] and (L, 4) quaternions of the regions of ELLIPSOID_PROBABILITY."""
    variances, axes = np.linalg.eigh(covariances)
    axes *= np.sign(np.linalg.det(axes))[:, None, None]
    size = 2.0 * _STDS * np.sqrt(np.maximum(variances, 0.0))
    return np.maximum(size, 1e-3), quaternions(axes)


def quaternions(rotations: FloatArray) -> FloatArray:
    """(L, 4) x, y, z, w of rotations (L, 3, 3): the longest row of 4 q q', with length one."""
    count = len(rotations)
    diagonal = rotations.reshape(count, 9)[:, ::4]
    trace = diagonal[:, 0] + diagonal[:, 1] + diagonal[:, 2]
    products = np.empty((count, 4, 4))
    products[:, :3, :3] = rotations + rotations.swapaxes(1, 2)
    turned = rotations[:, _AFTER, _BEFORE] - rotations[:, _BEFORE, _AFTER]
    products[:, :3, 3] = products[:, 3, :3] = turned
    products.reshape(count, 16)[:, :15:5] += (1.0 - trace)[:, None]
    products[:, 3, 3] = 1.0 + trace
    longest = np.column_stack((diagonal, trace)).argmax(axis=1)
    row = products[np.arange(count), longest]
    return row / np.sqrt(np.square(row).sum(axis=1, keepdims=True))
