"""Transforms between coordinate frames that do not move: `/tf_static`, and what stands still of `/tf`."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from tubepose.transforms import FloatArray, invert_transform, make_transform

# Two messages of one transform that differ by more tell a moving frame.
_STILL_M = 1e-4
_STILL_TURN = 1e-4
# Numbers of a transform that was never set, or is none.
_MOST = 1e6
_LEAST_TURN = 1e-6


class StaticTransforms:
    """A graph of coordinate frames; its edges are transforms (tf2: the pose of a child in its parent)."""

    def __init__(self) -> None:
        self._edges: dict[tuple[str, str], FloatArray] = {}
        self._moving: set[tuple[str, str]] = set()

    def add(self, parent: str, child: str, transform: Any) -> None:
        """Note the pose of a child frame in its parent, a `geometry_msgs/Transform`; one that is none says nothing."""
        self._note(parent, child, matrix_of(transform))

    def add_inverse(self, parent: str, child: str, transform: Any) -> None:
        """Note the transform from a parent's points to a child's."""
        T = matrix_of(transform)
        self._note(parent, child, None if T is None else invert_transform(T))

    def knows(self, frame: str) -> bool:
        """Whether some transform is of a frame."""
        return any(frame.lstrip("/") in edge for edge in self._edges)

    def between(self, target: str, source: str) -> FloatArray | None:
        """Transform (4, 4) that maps points of the source frame to the target frame, metres; None where no path leads.

        Names are compared without a leading slash, as tf2 does.
        """
        target, source = target.lstrip("/"), source.lstrip("/")
        reached: dict[str, FloatArray] = {target: np.eye(4)}
        todo = deque([target])
        while todo and source not in reached:
            here = todo.popleft()
            for (parent, child), T_parent_child in self._edges.items():
                if (parent, child) in self._moving:
                    continue
                if parent == here and child not in reached:
                    reached[child] = reached[here] @ T_parent_child
                    todo.append(child)
                elif child == here and parent not in reached:
                    reached[parent] = reached[here] @ invert_transform(T_parent_child)
                    todo.append(parent)
        return reached.get(source)

    def _note(self, parent: str, child: str, T_parent_child: FloatArray | None) -> None:
        edge = (parent.lstrip("/"), child.lstrip("/"))
        if T_parent_child is None or edge[0] == edge[1]:
            return
        known = self._edges.setdefault(edge, T_parent_child)
        off = np.abs(known - T_parent_child)
        if off[:3, 3].max() > _STILL_M or off[:3, :3].max() > _STILL_TURN:
            self._moving.add(edge)


def matrix_of(transform: Any) -> FloatArray | None:
    """A `geometry_msgs/Transform` as (4, 4) matrix, metres; None for one that was never set."""
    turn, shift = transform.rotation, transform.translation
    quaternion = np.array([turn.x, turn.y, turn.z, turn.w], dtype=float)
    translation = np.array([shift.x, shift.y, shift.z], dtype=float)
    numbers = np.concatenate([quaternion, translation])
    if not (np.abs(numbers) < _MOST).all() or np.linalg.norm(quaternion) < _LEAST_TURN:
        return None
    return make_transform(Rotation.from_quat(quaternion).as_matrix(), translation)
