"""Method `profile`: every tube of a frame at once, from its top, its wall and its slot (docs/method.md, "Profile")."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

from tubepose.checks import failed
from tubepose.config import Config
from tubepose.methods.method import MethodResult, estimate_of, not_asked
from tubepose.methods.profile_boxes import allowed_types, boxes_alone
from tubepose.profile import FaceBow, ProfileTube, fit_profiles
from tubepose.rack import RackPose
from tubepose.scene import Scene, TubeEstimate, TubeTarget
from tubepose.stage_times import StageTime
from tubepose.tubes_pitch import refuse_by_tops


@dataclass(frozen=True, slots=True)
class Profile:
    """The `Method` that looks at the whole frame, and finds its tubes and their slots itself.

    Attributes:
        name: As `Method.name`.
        is_stochastic: As `Method.is_stochastic`.
        needs_targets: As `Method.needs_targets`.
        packages: As `Method.packages`.
    """

    name: str = "profile"
    is_stochastic: bool = False
    needs_targets: bool = False
    packages: tuple[str, ...] = ()

    def estimate(self, scene: Scene, config: Config, seed: int | None = None) -> MethodResult:
        """As `Method.estimate`; its time is shared out evenly among the tubes.

        A rack whose slots lie elsewhere than the measured tops is refused, and its tubes with it.
        """
        del seed
        if scene.rack_pose.T_camera_rack is None:
            return MethodResult(scene, (), ())
        start = time.perf_counter_ns()
        found = _fit(scene, config)
        share_ms = (time.perf_counter_ns() - start) / 1e6 / max(len(found), 1)
        times = tuple(StageTime("tube", self.name, tube.slot or "", None, share_ms) for tube in found)
        judged, estimates = refuse_by_tops(scene, self._estimates(scene, found, config), config)
        return MethodResult(judged, estimates, times)

    def note(self, config: Config, seeds: int) -> str:
        """As `Method.note`: none."""
        del config, seeds
        return ""

    def _estimates(self, scene: Scene, found: tuple[ProfileTube, ...], config: Config) -> tuple[TubeEstimate, ...]:
        """What was found, then boxes in whose slots nothing was."""
        targets = [(_target(tube), tube.pose) for tube in found]
        targets += [(other, replace(not_asked(other), n_points=0)) for other in boxes_alone(scene, found, config)]
        return tuple(estimate_of(scene, self.name, None, *target) for target in targets)


def _fit(scene: Scene, config: Config) -> tuple[ProfileTube, ...]:
    assert scene.rack_pose.T_camera_rack is not None
    return fit_profiles(
        scene.frame,
        scene.intrinsics,
        scene.rack_pose.T_camera_rack,
        scene.rack,
        scene.tubes,
        config,
        rack_covariance=scene.rack_pose.covariance,
        allowed=allowed_types(scene),
        bow=_bow(scene.rack_pose),
        noise=scene.noise,
    )


def _bow(pose: RackPose) -> FaceBow | None:
    return None if pose.bow_m is None or pose.bow_std_m is None else FaceBow(pose.bow_m, pose.bow_std_m)


def _target(tube: ProfileTube) -> TubeTarget:
    why = next(iter(failed(tube.pose.checks)), None) if tube.tube is None else None
    return TubeTarget(None, tube.slot, tube.tube, float("nan"), why, tube.points_m, top_support=tube.support)


PROFILE = Profile()
