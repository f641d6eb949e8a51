"""What is wrong with an answer, by exact truth: rack, slots and tubes that are stated and not so."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, replace

import numpy as np
from scipy.spatial.transform import Rotation

from tubepose.labware import RackModel, TubeModel
from tubepose.simulation.bow import FLAT, Bow
from tubepose.transforms import FloatArray, invert_transform, make_transform, transform_points

WRONG_M, WRONG_RAD = 2e-3, float(np.deg2rad(2.0))
"""What counts as wrong: the robot's gripper of the project misses a tube by more (issue 20)."""
SAME_M = 1e-4
"""Centres of slots that are nearer than this are the same: a hundredth of a slot's play is less."""
NEAR_M = 8e-3
"""A tube that is claimed farther than this from the axes of all true ones, half of a common pitch, is none of them."""


@dataclass(frozen=True, slots=True, eq=False)
class TrueTube:
    """A tube that stands there; `T_camera_tube` (4, 4) maps its points to camera points, metres."""

    slot: str
    model: TubeModel
    T_camera_tube: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """What stands before the camera.

    Attributes:
        rack: The rack; None where there is none.
        T_camera_rack: Its pose, shape (4, 4), metres.
        tubes: The tubes in it.
        bow: Of the rack.
    """

    rack: RackModel | None
    T_camera_rack: FloatArray
    tubes: tuple[TrueTube, ...]
    bow: Bow = FLAT

    def moved(self, T: FloatArray) -> Truth:
        """The same seen from another frame: `T` (4, 4) maps points of the camera's frame to it."""
        tubes = tuple(TrueTube(tube.slot, tube.model, T @ tube.T_camera_tube) for tube in self.tubes)
        return Truth(self.rack, T @ self.T_camera_rack, tubes, self.bow)


@dataclass(frozen=True, slots=True, eq=False)
class StatedTube:
    """A tube that an estimator states with status `ok`; `covariance` (5, 5) is that of its pose, where it is stated."""

    slot: str | None
    type_name: str
    model: TubeModel
    T_camera_tube: FloatArray
    covariance: FloatArray | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Answer:
    """What an estimator says of one frame.

    Attributes:
        rack: The rack that it was asked for.
        T_camera_rack: Pose of an accepted rack, shape (4, 4), metres; None of a refused one.
        ambiguous: Whether the rack may stand the other way round as well.
        reason: Why there is no rack; its reason code where there is one.
        tubes: Tubes with status `ok`.
        slots: State of every slot: `empty`, `occupied`, or words that state neither.
        marks: Codes of the checks that mark an accepted rack.
    """

    rack: RackModel
    T_camera_rack: FloatArray | None
    ambiguous: bool
    reason: str
    tubes: tuple[StatedTube, ...] = ()
    slots: Mapping[str, str] | None = None
    marks: frozenset[str] = frozenset()


@dataclass(frozen=True, slots=True)
class Verdict:
    """Counts of one answer. All but the first group are statements that are wrong and carry no mark.

    Attributes:
        racks: Racks accepted, 0 or 1.
        ambiguous: Accepted ones that are marked ambiguous.
        needless: Of these, ones whose true rack looks the same under no turn.
        tubes: Tubes stated.
        kept: True tubes that a stated one without any fault belongs to.
        not_stated: Slots of the accepted rack that are called neither empty nor occupied.
        axial_unseen: Open tubes that are off along their axes: where the floor is, the capture does not show.
        wrong_racks: Accepted, but another rack, or off at its face.
        wrong_type: Stated tubes of another type, or where no tube is.
        wrong_slot: Stated tubes under a slot's name that is not theirs.
        lateral: Stated tubes that are off across their axes.
        tilt: Stated tubes whose axes are turned too far.
        axial: Stated tubes with a closed cap that are off along their axes.
        wrong_tubes: Stated tubes with any fault of the five above.
        false_empty: Slots that are called empty and hold a tube.
        false_occupied: Slots that are called occupied and hold none.
        marked: Accepted racks that are off at their face and say so: their scale is marked.
        scale_marks: Accepted racks with such a mark, off or not.
    """

    racks: int = 0
    ambiguous: int = 0
    needless: int = 0
    tubes: int = 0
    kept: int = 0
    not_stated: int = 0
    axial_unseen: int = 0
    wrong_racks: int = 0
    wrong_type: int = 0
    wrong_slot: int = 0
    lateral: int = 0
    tilt: int = 0
    axial: int = 0
    wrong_tubes: int = 0
    false_empty: int = 0
    false_occupied: int = 0
    marked: int = 0
    scale_marks: int = 0

    @property
    def wrong(self) -> int:
        """All wrong statements."""
        return self.wrong_racks + self.wrong_tubes + self.false_empty + self.false_occupied

    def __add__(self, other: Verdict) -> Verdict:
        """Counts of both."""
        return Verdict(*(getattr(self, f.name) + getattr(other, f.name) for f in fields(self)))


def judge(truth: Truth, answer: Answer, same_rack: bool, face_truth: Truth | None = None) -> Verdict:
    """Compare an answer with what stands there.

    Where the answer is marked ambiguous, each turn under which the true rack looks the same counts as right, and the
    one that leaves the fewest faults is taken.

    Args:
        truth: What stands there.
        answer: What was said.
        same_rack: Whether the rack that was asked for is the one that stands there, however well its file describes
            it.
        face_truth: Truth that the rack's pose is judged by where it is not `truth`'s.
    """
    if answer.T_camera_rack is None:
        return Verdict()
    turns = [T for T in _turns(truth) if answer.ambiguous or T is _NO_TURN]
    verdicts = []
    for turn in turns:
        off = not same_rack or face_is_off(_turned(face_truth or truth, turn), answer)
        verdict = _judged(_turned(truth, turn), answer, off)
        if off and same_rack and answer.marks & SCALE_MARKS:
            verdict = replace(verdict, wrong_racks=0, marked=1)
        verdicts.append(verdict)
    best = min(verdicts, key=lambda verdict: (verdict.wrong, -verdict.kept))
    needless = int(answer.ambiguous and same_rack and len(turns) == 1)
    marks = int(bool(answer.marks & SCALE_MARKS))
    return best + Verdict(racks=1, ambiguous=int(answer.ambiguous), needless=needless, scale_marks=marks)


SCALE_MARKS = frozenset(("scale", "scale_unknown"))
"""Marks that say that an accepted rack is off along the line of sight, or that nobody can tell."""
PITCH_MARKS = frozenset(("pitch_x", "pitch_y"))
"""Marks that say that slots are not where the rack's file has them."""
_NO_TURN: FloatArray = np.eye(4)


def _turns(truth: Truth) -> list[FloatArray]:
    """Turns about its axis under which a rack looks the same."""
    if truth.rack is None:
        return [_NO_TURN]
    found = [_NO_TURN]
    for quarter in (1, 2, 3):
        rotation = Rotation.from_euler("z", 90.0 * quarter, degrees=True).as_matrix()
        turn = make_transform(np.round(rotation), np.zeros(3))
        if slots_under(truth.rack, turn) is not None:
            found.append(turn)
    return found


def slots_under(rack: RackModel, turn: FloatArray) -> dict[str, str] | None:
    """Which slot each slot (key) is called in a rack that is described in axes turned by `turn`; None: not the same."""
    size = np.abs(turn[:2, :2]) @ rack.outline_m
    if not np.allclose(size, rack.outline_m, atol=SAME_M):
        return None
    centers, names = rack.slot_centers_m, {}
    for slot in rack.all_slots:
        away = np.linalg.norm(centers - turn[:2, :2].T @ slot.center_m, axis=1)
        other = rack.all_slots[int(away.argmin())]
        size = np.abs(turn[:2, :2]) @ other.half_size_m
        alike = other.shape == slot.shape and np.allclose(size, slot.half_size_m, atol=SAME_M)
        if away.min() > SAME_M or not alike:
            return None
        names[slot.name] = other.name
    return names


def _turned(truth: Truth, turn: FloatArray) -> Truth:
    """The same rack and tubes with the rack's axes turned, and the slots named accordingly."""
    if truth.rack is None or turn is _NO_TURN:
        return truth
    names = slots_under(truth.rack, turn) or {}
    tubes = tuple(TrueTube(names[tube.slot], tube.model, tube.T_camera_tube) for tube in truth.tubes)
    return Truth(truth.rack, truth.T_camera_rack @ turn, tubes, truth.bow)


def face_is_off(truth: Truth, answer: Answer) -> bool:
    """Whether an accepted rack is not there, or more than 2 mm or 2 deg off at the centre of its face."""
    T = answer.T_camera_rack
    if truth.rack is None or T is None:
        return True
    shift = transform_points(T, np.array([0.0, 0.0, answer.rack.height_m])) - transform_points(
        truth.T_camera_rack, np.array([0.0, 0.0, truth.rack.height_m])
    )
    turned = Rotation.from_matrix(truth.T_camera_rack[:3, :3].T @ T[:3, :3]).magnitude()
    return bool(np.linalg.norm(shift) > WRONG_M or turned > WRONG_RAD)


def _judged(truth: Truth, answer: Answer, rack_is_off: bool) -> Verdict:
    total = Verdict(wrong_racks=int(rack_is_off))
    for verdict in (*_tube_verdicts(truth, answer), *_slot_verdicts(truth, answer)):
        total += verdict
    return total


def _tube_verdicts(truth: Truth, answer: Answer) -> Iterator[Verdict]:
    for stated in answer.tubes:
        nearest = min(truth.tubes, key=lambda tube: _apart_m(stated, tube), default=None)
        if nearest is None or _apart_m(stated, nearest) > NEAR_M:
            yield Verdict(tubes=1, wrong_type=1, wrong_tubes=1)
            continue
        across, along, angle = _errors(_but_for_marks(stated, nearest, answer), nearest.T_camera_tube)
        shown = nearest.model.cap is not None and not nearest.model.cap.open
        far = abs(along) > WRONG_M
        faults = (
            int(stated.type_name != nearest.model.name),
            int(stated.slot != nearest.slot),
            int(across > WRONG_M and not answer.marks & PITCH_MARKS),
            int(angle > WRONG_RAD),
            int(far and shown),
        )
        wrong = int(any(faults))
        kept, unseen = 1 - wrong, int(far and not shown)
        yield Verdict(0, 0, 0, 1, kept, 0, unseen, 0, *faults, wrong)


def _but_for_marks(stated: StatedTube, tube: TrueTube, answer: Answer) -> FloatArray:
    """T_camera_tube of a stated tube, without what its rack's mark says to be unknown: the distance along the sight."""
    if not answer.marks & SCALE_MARKS:
        return stated.T_camera_tube
    sight = tube.T_camera_tube[:3, 3] / np.linalg.norm(tube.T_camera_tube[:3, 3])
    T = stated.T_camera_tube.copy()
    T[:3, 3] -= ((T[:3, 3] - tube.T_camera_tube[:3, 3]) @ sight) * sight
    return T


def _apart_m(stated: StatedTube, tube: TrueTube) -> float:
    """Distance of a stated tube's top from the axis of a true one, metres."""
    top = transform_points(stated.T_camera_tube, np.array([0.0, 0.0, stated.model.height_m]))
    return float(np.hypot(*transform_points(invert_transform(tube.T_camera_tube), top)[:2]))


def _errors(T_stated: FloatArray, T_true: FloatArray) -> tuple[float, float, float]:
    """Across: true origin to the stated axis, metres; along the true axis, metres; angle between the axes, radians."""
    across = float(np.hypot(*transform_points(invert_transform(T_stated), T_true[:3, 3])[:2]))
    along = float((T_stated[:3, 3] - T_true[:3, 3]) @ T_true[:3, 2])
    angle = float(np.arctan2(np.linalg.norm(np.cross(T_stated[:3, 2], T_true[:3, 2])), T_stated[:3, 2] @ T_true[:3, 2]))
    return across, along, angle


def _slot_verdicts(truth: Truth, answer: Answer) -> Iterator[Verdict]:
    held = {tube.slot for tube in truth.tubes}
    for name, state in (answer.slots or {}).items():
        if state == "empty":
            yield Verdict(false_empty=int(name in held))
        elif state == "occupied":
            yield Verdict(false_occupied=int(name not in held))
        else:
            yield Verdict(not_stated=1)
