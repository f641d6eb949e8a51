"""What every method is: one call from what is known of a frame to the poses of its tubes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Protocol

from tubepose.config import Config
from tubepose.errors import TubePoseError
from tubepose.labware import RackModel, SlotModel, TubeModel
from tubepose.preprocessing import remove_outliers
from tubepose.scene import Scene, TubeEstimate, TubeTarget
from tubepose.stage_times import Clock, StageTime
from tubepose.transforms import FloatArray
from tubepose.tube import TubePose, refused


@dataclass(frozen=True, slots=True, eq=False)
class MethodResult:
    """What a method says of a frame.

    Attributes:
        scene: What it was asked, its rack as the method leaves it: measured tops can refuse a rack.
        estimates: One for every tube, and for whatever else was found; empty without the rack's pose.
        times: Duration per tube.
    """

    scene: Scene
    estimates: tuple[TubeEstimate, ...]
    times: tuple[StageTime, ...]


class Method(Protocol):
    """Frame, rack pose, rack, tubes, boxes (a `Scene` holds them) and config -> result: the one signature of all."""

    @property
    def name(self) -> str:
        """Name on the command line and in the tables."""
        ...

    @property
    def is_stochastic(self) -> bool:
        """Whether the answer depends on the seed."""
        ...

    @property
    def needs_targets(self) -> bool:
        """Whether it is told which detected tube stands in which slot; else it finds tubes and slots itself."""
        ...

    @property
    def packages(self) -> tuple[str, ...]:
        """Packages of the extra ``rivals`` that it imports."""
        ...

    def estimate(self, scene: Scene, config: Config, seed: int | None = None) -> MethodResult:
        """Poses of all tubes of a frame.

        Args:
            scene: The frame, its rack and the rack's pose, the types of tube and the boxes.
            config: All sections.
            seed: Of a stochastic method; None otherwise.

        Raises:
            TubePoseError: A package that the method needs is not installed.
        """
        ...

    def note(self, config: Config, seeds: int) -> str:
        """Settings in one sentence, for the notes of a table with `seeds` seeds; empty where there are none."""
        ...


class TubeFit(Protocol):
    """A way from one tube's points to its pose."""

    def __call__(
        self, points_m: FloatArray, slot: SlotModel, tube: TubeModel, rack: RackModel, config: Config, seed: int
    ) -> TubePose:
        """Estimate from points of shape (N, 3) in the rack frame, metres."""
        ...


@dataclass(frozen=True, slots=True)
class EachTube:
    """A `Method` that looks at one tube at a time: at the points that a detector and its slot give it.

    Attributes:
        name: As `Method.name`.
        fit: What is asked for every tube.
        is_stochastic: As `Method.is_stochastic`.
        packages: As `Method.packages`.
        settings: Makes the note from config and number of seeds, where the method has one.
        needs_targets: True: without slots and types there is nothing to ask.
    """

    name: str
    fit: TubeFit
    is_stochastic: bool = False
    packages: tuple[str, ...] = ()
    settings: Callable[[Config, int], str] | None = None
    needs_targets: bool = True

    def estimate(self, scene: Scene, config: Config, seed: int | None = None) -> MethodResult:
        """As `Method.estimate`; a target without a slot or a type is rejected with its reason."""
        clock = Clock()
        estimates = []
        for target in scene.targets:
            if target.slot is None or target.tube is None:
                pose = not_asked(target)
            else:
                slot = scene.rack.slot(target.slot)
                with clock.stage("tube", self.name, target.slot, seed):
                    points_m = remove_outliers(target.points_m, config.preprocess)
                    pose = self.fit(points_m, slot, target.tube, scene.rack, config, seed or 0)
            estimates.append(estimate_of(scene, self.name, seed, target, pose))
        return MethodResult(scene, tuple(estimates), tuple(clock.times))

    def note(self, config: Config, seeds: int) -> str:
        """As `Method.note`."""
        return self.settings(config, seeds) if self.settings is not None else ""


def estimate_of(scene: Scene, method: str, seed: int | None, target: TubeTarget, pose: TubePose) -> TubeEstimate:
    """A pose in the rack frame as the answer of a method, with the pose in the camera frame."""
    T_camera_rack = scene.rack_pose.T_camera_rack
    T_camera_tube = None
    if pose.T_rack_tube is not None and T_camera_rack is not None:
        T_camera_tube = T_camera_rack @ pose.T_rack_tube
    return TubeEstimate(method, seed, target, pose, T_camera_tube)


def not_asked(target: TubeTarget) -> TubePose:
    """The answer of every method for a target without a slot or a type."""
    assert target.why is not None
    return refused(target.why, n_points=len(target.points_m))


def require_packages(method: str, packages: Sequence[str]) -> None:
    """Import what a method needs.

    Raises:
        TubePoseError: A package is not installed.
    """
    for package in packages:
        try:
            import_module(package)
        except ImportError:
            raise TubePoseError(
                f"method '{method}' needs the package {package}, which is not installed; in a checkout: "
                "pip install '.[rivals]'"
            ) from None


def millimetres(*lengths_m: float) -> str:
    """Lengths in words, for notes."""
    return ", ".join(f"{length * 1e3:g}" for length in lengths_m) + " mm"
