"""Boxes without a network: the height band of the rack's top, and what stands above it, parted by the slots."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from tubepose.capture.frame import RgbdFrame
from tubepose.config import Config
from tubepose.detection.model import TUBE_CLASS, Detection, Detector
from tubepose.labware import RackModel, TubeModel
from tubepose.labware.tubes import RACK_CLASS
from tubepose.preprocessing import TALLEST_TUBE_M
from tubepose.rack.edges import best_registration, coarse_sample
from tubepose.rack.fit import top_frame
from tubepose.rack.pose import MIN_POINTS
from tubepose.rack.search import levels
from tubepose.rack_band import find_rack_top
from tubepose.transforms import FloatArray, invert_transform, transform_points

CELL_M = 5e-4
# What stands on a rack may lean over its outline. What lies around it tells where it ends: a line of slots farther, and
# the table.
MARGIN_M, AROUND_M = 5e-3, 40e-3


@dataclass(frozen=True)
class GeometricDetector(Detector):
    """Detector that knows the rack's definition and sees only the cloud.

    Attributes:
        rack: The rack that is looked for.
        tubes: The kinds of tube that can stand in it: their heights and radii part touching caps.
        config: Sections rack_top, slots and preprocess are used.
    """

    rack: RackModel
    tubes: tuple[TubeModel, ...] = ()
    config: Config = field(default_factory=Config)
    name: str = "geometric"

    def detect(self, frame: RgbdFrame) -> tuple[Detection, ...]:
        """One rack, and a ``tube`` for every group of points that stands on it.

        Where no band fits the rack, the whole cloud is returned as a rack of score 0, so that the registration can say
        what is wrong with it.
        """
        rows = np.flatnonzero(frame.valid)
        points = frame.points_m[rows]
        T_camera_top = self._find_top(points)
        if T_camera_top is None:
            return (self._detection(frame, RACK_CLASS, 0.0, rows, rows),)
        local = transform_points(invert_transform(T_camera_top), points)
        on_rack = self._on_rack(local)
        band = on_rack & (np.abs(local[:, 2]) < self.config.rack_top.band_m)
        around = self._around_rack(local) if self.config.rack.method == "edges" else on_rack
        rack = self._detection(frame, RACK_CLASS, 1.0, rows[around], rows[band])
        return (rack, *self._standing(frame, rows[on_rack], local[on_rack]))

    def tubes_on(self, frame: RgbdFrame, T_camera_rack: FloatArray) -> tuple[Detection, ...]:
        """A ``tube`` for every group of points that stands on a rack whose pose is known.

        Args:
            frame: The frame.
            T_camera_rack: Array of shape (4, 4); maps rack points to camera points, metres.
        """
        rows = np.flatnonzero(frame.valid)
        local = transform_points(invert_transform(top_frame(T_camera_rack, self.rack)), frame.points_m[rows])
        on_rack = self._on_rack(local)
        return self._standing(frame, rows[on_rack], local[on_rack])

    def _on_rack(self, local_m: FloatArray) -> NDArray[np.bool_]:
        """Which points (N, 3), frame of the top, are of the rack or of what stands on it."""
        near = np.all(np.abs(local_m[:, :2]) < self.rack.outline_m / 2 + MARGIN_M, axis=1)
        return np.asarray(near & (local_m[:, 2] > -self.rack.height_m) & (local_m[:, 2] < TALLEST_TUBE_M))

    def _around_rack(self, local_m: FloatArray) -> NDArray[np.bool_]:
        """Which points (N, 3), frame of the top, a registration is judged by: those of the rack and beside it."""
        beyond_m = (np.abs(local_m[:, :2]) - self.rack.outline_m / 2).max(axis=1)
        above_base = local_m[:, 2] > -self.rack.height_m
        return np.asarray((beyond_m < AROUND_M) & (above_base | (beyond_m > 0)) & (local_m[:, 2] < TALLEST_TUBE_M))

    def _standing(self, frame: RgbdFrame, rows: NDArray[np.intp], local_m: FloatArray) -> tuple[Detection, ...]:
        """Tubes among points of the rack: their rows of the frame (N,), and themselves (N, 3), frame of the top."""
        standing = local_m[:, 2] > self.config.slots.clearance_m
        labels = self._part(local_m[standing], self.rack.slot_centers_m)
        groups = (rows[standing][labels == label] for label in range(labels.max(initial=-1) + 1))
        return tuple(self._detection(frame, TUBE_CLASS, 1.0, members, members) for members in groups)

    def _find_top(self, points_m: FloatArray) -> FloatArray | None:
        """T_camera_top, origin at the middle of the rack's top, z up; None where no band fits the rack."""
        config = self.config.rack_top
        if len(points_m) < MIN_POINTS:
            return None
        if self.config.rack.method == "obb-icp":
            top = find_rack_top(points_m, self.rack, config)
            return top.T_camera_top if top is not None and top.fits(config) else None
        few_m = coarse_sample(points_m, config)
        best = best_registration(points_m, few_m, levels(few_m, config), self.rack, self.config)
        return None if best is None or best.reason else top_frame(best.fit.T_camera_rack, self.rack)

    def _part(self, points_m: FloatArray, centers_m: FloatArray) -> NDArray[np.intp]:
        """Label of every standing point (N, 3), frame of the top; shape (N,), -1 for points of no tube.

        Caps and rims are discs at known heights that cannot overlap: they are found one by one where a disc of their
        radius covers most points. What stands on a slot without such a top is a group too: a tube of unknown kind.
        """
        if len(points_m) == 0:
            return np.empty(0, np.intp)
        xy = points_m[:, :2]
        pitch_m = float(np.median(self.rack.pitches_m))
        radius_m = max((tube.max_radius_m for tube in self.tubes), default=pitch_m / 2)
        tops = np.zeros(len(xy), bool)
        for tube in self.tubes:
            height_m = self.rack.floor_m + tube.height_m - self.rack.height_m
            tops |= np.abs(points_m[:, 2] - height_m) < self.config.slots.top_band_m
        found = _cover_by_discs(xy[tops], radius_m, self.config.preprocess.min_tube_points)
        explained = np.zeros(len(xy), bool)
        if len(found):
            explained = np.asarray(cKDTree(found).query(xy)[0]) < 1.5 * radius_m
        unknown = _filled_slots(xy[~explained], centers_m, 0.35 * pitch_m, 2 * self.config.preprocess.min_tube_points)
        middles = np.vstack([found, centers_m[unknown]])
        if len(middles) == 0:
            return np.full(len(xy), -1)
        distance, label = cKDTree(middles).query(xy)
        return np.where(distance < 1.5 * radius_m, label, -1)

    @staticmethod
    def _detection(
        frame: RgbdFrame, class_name: str, score: float, rows: NDArray[np.intp], box_rows: NDArray[np.intp]
    ) -> Detection:
        box = (float("nan"),) * 4
        if frame.organised and len(box_rows):
            v, u = np.divmod(box_rows, frame.cloud_m.shape[1])
            box = (float(u.min()), float(v.min()), float(u.max()), float(v.max()))
        return Detection(class_name, score, box, "geometric", rows)


def _filled_slots(xy_m: FloatArray, centers_m: FloatArray, radius_m: float, min_points: int) -> list[int]:
    """Slots whose middle is covered by points (N, 2): something stands there.

    Light that went through a neighbour's wall leaves points too, but in a corner of the slot: their hull is small.
    """
    filled: list[int] = []
    if len(xy_m) == 0:
        return filled
    tree = cKDTree(xy_m)
    for slot, center in enumerate(centers_m):
        near = tree.query_ball_point(center, radius_m)
        if len(near) >= min_points:
            hull = cv2.convexHull((xy_m[near] * 1e3).astype(np.float32))
            if cv2.contourArea(hull) * 1e-6 > 0.5 * np.pi * radius_m**2:
                filled.append(slot)
    return filled


def _cover_by_discs(xy_m: FloatArray, radius_m: float, min_points: int) -> FloatArray:
    """Centres of discs, shape (K, 2), that cover points (N, 2) one disc after the other, the fullest first.

    Stops at a disc with less than `min_points` or a quarter of the points of the fullest one: slivers of mixed pixels.
    """
    if len(xy_m) < min_points:
        return np.empty((0, 2))
    reach = int(np.ceil(radius_m / CELL_M))
    low = xy_m.min(axis=0)
    cells = np.rint((xy_m - low) / CELL_M).astype(np.intp) + reach
    raster = np.zeros(cells.max(axis=0) + reach + 1, np.float32)
    np.add.at(raster, (cells[:, 0], cells[:, 1]), 1)
    offsets = np.arange(-reach, reach + 1) * CELL_M
    square = np.hypot(*np.meshgrid(offsets, offsets))
    kernel = np.where(square <= radius_m, 1.0, 0.0).astype(np.float32)
    centers: list[FloatArray] = []
    fullest = 0.0
    rows, columns = np.indices(raster.shape)
    while True:
        score = cv2.filter2D(raster, cv2.CV_32F, kernel, borderType=cv2.BORDER_CONSTANT)
        count = float(score.max())
        fullest = max(fullest, count)
        if count < max(min_points, 0.25 * fullest):
            break
        # Several places cover the same points: take their middle.
        best = np.argwhere(score >= count - 0.5)
        near = best[np.hypot(*(best - best[0]).T) < reach]
        center = near.mean(axis=0)
        covered = np.hypot(rows - center[0], columns - center[1]) <= (radius_m + 1.5e-3) / CELL_M
        raster[covered] = 0
        centers.append((center - reach) * CELL_M + low)
    return np.array(centers).reshape(-1, 2)
