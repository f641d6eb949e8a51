"""The sensor's noise in tubes: a plane that it bends is not believed, and a height is not blamed for it."""

from dataclasses import replace

import numpy as np
import profile_scenes as ps
import pytest
import scenes

from tubepose.config import Config
from tubepose.labware import load_rack, load_tube
from tubepose.profile.estimate import fit_frame
from tubepose.profile.top_noise import depths_m, height_limit_m, noisy_config, wall_noise
from tubepose.sensor import measure_noise, prior_noise
from tubepose.sensor.noise import PRIOR
from tubepose.simulation.depth_noise import DepthNoise
from tubepose.tube import TubeStatus

CONFIG = Config()
RACK = load_rack("chen2023-soft-5x10")
LOW, HIGH = (load_tube(f"chen2023-tube-{i}") for i in (2, 3))
VIEW = scenes.camera_from_rack(RACK, 0.3, 0.1, 0.65)
PLACED = {
    slot: (HIGH if k % 2 else LOW, scenes.tube_pose(RACK, slot, 0.008 * np.cos(k), 0.008 * np.sin(k)))
    for k, slot in enumerate(f"{row}{column}" for row in "ACE" for column in (1, 3, 6, 8, 10))
}
QUIET = replace(prior_noise(CONFIG.sensor), independent_m=1e-5, shared_m=1e-6)


@pytest.fixture(scope="module")
def clean():
    return ps.rendered(RACK, PLACED, VIEW, resolution=860)


def noisy(frame, std_m, shared_share, correlation_m=3e-3):
    law = DepthNoise(
        independent_m=std_m * np.sqrt(1 - shared_share), shared_m=std_m * np.sqrt(shared_share),
        correlation_m=correlation_m,
    )  # fmt: skip
    return law.applied(frame, np.random.default_rng(0))


def asked(frame, noise):
    return fit_frame(frame, frame.intrinsics, VIEW, RACK, [LOW, HIGH], CONFIG, noise=noise)


@pytest.mark.parametrize("shared_share", [0.0, 0.5, 1.0])
def test_half_a_millimetre_of_noise_rejects_no_tube_for_its_height_and_errors_are_honest(clean, shared_share):
    frame = noisy(clean, 0.5e-3, shared_share)
    noise = measure_noise(frame, frame.intrinsics, VIEW, RACK, CONFIG.sensor)
    found = asked(frame, noise).tubes
    assert {entry.slot: entry.tube for entry in found} == {slot: tube for slot, (tube, _) in PLACED.items()}
    kept = [entry for entry in found if entry.pose.status is TubeStatus.OK]
    # Where a tube is rejected it is for a tilt that is not known, and not for something that it does.
    assert {entry.pose.reason[:12] for entry in found} <= {"", "its tilt is "}
    assert len(kept) >= 0.9 * len(PLACED)
    _, squares = ps.errors_of(kept, {entry.slot: PLACED[entry.slot] for entry in kept})
    assert np.mean(squares) < 8  # 5 if exact
    assert squares.max() < 20.5  # chi-square with 5 degrees of freedom, 0.1 %


def test_a_plane_that_noise_bends_is_distrusted_and_the_circle_carries(clean):
    frame = noisy(clean, 0.5e-3, 1.0)
    noise = measure_noise(frame, frame.intrinsics, VIEW, RACK, CONFIG.sensor)
    tilts = {}
    for name, told in (("measured", noise), ("blind", replace(QUIET, source="table"))):
        found = [entry for entry in asked(frame, told).tubes if entry.slot in PLACED]
        tilts[name] = ps.errors_of(found, {entry.slot: PLACED[entry.slot] for entry in found})[0].tilt_deg
    # The planes alone are off by 2.6 deg; with the circle and the slot the axis is not.
    assert tilts["measured"].mean() < 0.4
    assert tilts["measured"].mean() < 0.7 * tilts["blind"].mean()


def test_more_noise_makes_no_tube_surer(clean, monkeypatch):
    monkeypatch.setattr("tubepose.profile.estimate.seen_on_caps", lambda noise, discs: noise)
    before = None
    for shared_m in (2e-5, 1e-4, 5e-4):
        noise = replace(QUIET, shared_m=shared_m, source="table")
        stds = np.array([np.sqrt(np.trace(entry.pose.covariance[:2, :2])) for entry in asked(clean, noise).tubes])
        assert before is None or np.all(stds > before - 1e-6)
        before = stds


def test_what_is_not_given_is_told_by_the_caps(clean):
    frame = noisy(clean, 0.3e-3, 0.5)
    used = asked(frame, None).noise
    assert used.source == "caps"
    assert used.shared_m == pytest.approx(0.3e-3 * np.sqrt(0.5), rel=0.35)
    table = measure_noise(frame, frame.intrinsics, VIEW, RACK, CONFIG.sensor)
    assert asked(frame, replace(table, source="table")).noise.source == "table"


def test_the_limit_of_heights_grows_as_their_standard_deviation_does():
    limit = CONFIG.profile.max_height_error_m
    seat2 = CONFIG.profile.cap_height_m**2
    assert height_limit_m(np.array([0.0, 3 * seat2, 8 * seat2]), CONFIG.profile) == pytest.approx(
        [limit, 2 * limit, 3 * limit]
    )


def test_bands_grow_with_noise_and_ramps_with_blur():
    told = noisy_config(CONFIG, replace(QUIET, independent_m=1e-3), VIEW, RACK).profile
    assert told.top_band_m > 2 * CONFIG.profile.top_band_m
    assert told.edge_ramp_m == 0.0
    blurred = replace(QUIET, edge_blur_px=4.0, spacing_m=0.5e-3)
    # What is assumed is what today's scanner has; only a blur that was measured widens anything.
    assert noisy_config(CONFIG, replace(blurred, edge_source=PRIOR), VIEW, RACK).profile.edge_ramp_m == 0.0
    ramp = noisy_config(CONFIG, replace(blurred, edge_source="rack_outline"), VIEW, RACK).profile.edge_ramp_m
    assert 1.5e-3 < ramp < 2.0e-3
    quiet = noisy_config(CONFIG, replace(QUIET, edge_blur_px=0.0, edge_source="rack_outline"), VIEW, RACK).profile
    assert quiet.top_band_m == pytest.approx(CONFIG.profile.top_band_m, rel=1e-3)
    assert quiet.outline_noise_m == CONFIG.profile.outline_noise_m


def test_noise_along_the_line_of_sight_moves_walls_that_are_seen_from_the_side():
    above, beside = (np.array([x, 0.0, RACK.height_m + 0.6]) for x in (0.0, 0.6))
    noise = replace(QUIET, independent_m=1e-4, shared_m=2e-4)
    assert wall_noise(above, RACK, noise).shared_m == pytest.approx(0.0, abs=1e-12)
    slanted = wall_noise(beside, RACK, noise)
    scale = np.hypot(0.6, 0.6) / noise.distance_m
    assert slanted.shared_m == pytest.approx(2e-4 * np.sqrt(0.5) * scale)
    assert slanted.independent_m == pytest.approx(1e-4 * np.sqrt(0.5) * scale)


def test_depth_is_along_the_optical_axis_and_the_distance_in_a_turned_cloud():
    place = np.array([[0.05, 0.1, 0.2]])
    there = VIEW[:3, :3] @ place[0] + VIEW[:3, 3]
    assert depths_m(VIEW, place) == pytest.approx([there[2]])
    turned = np.array([[0.0, 0, 1, 0], [0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1]]) @ VIEW
    assert depths_m(turned, place) == pytest.approx([np.linalg.norm(there)])
