from __future__ import annotations

import functools

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tubepose.evaluation import AXES, ERROR_COLUMNS, compare, evaluate, seed_spread, summarise
from tubepose.labware import load_tube
from tubepose.pose_errors import add_s_mm, mssd_mm, pose_errors
from tubepose.transforms import make_transform, quaternion_wxyz, translation

TUBES = {name: load_tube(name) for name in ("chen2023-tube-1", "chen2023-tube-2")}
TUBE = TUBES["chen2023-tube-1"]
PROFILE = TUBE.outer_profile_m()
CAMERA = make_transform(Rotation.from_euler("xyz", [170, 8, 33], degrees=True).as_matrix(), np.array([0.05, -0.1, 0.9]))


def turned(x_deg=0.0, y_deg=0.0, spin_deg=0.0, t_mm=(0.0, 0.0, 0.0)):
    swing = Rotation.from_rotvec(np.deg2rad([x_deg, y_deg, 0.0]))
    spin = Rotation.from_euler("z", spin_deg, degrees=True)
    return make_transform((swing * spin).as_matrix(), np.array(t_mm) / 1e3)


def one(T_truth, T_estimate):
    return pose_errors(T_truth[None], T_estimate[None])


@pytest.mark.parametrize("spin_deg", [0, 17, 90, 180, -135, 359])
def test_one_degree_about_x_reads_one_degree_about_x_whatever_the_spin(spin_deg):
    found = one(CAMERA, CAMERA @ turned(x_deg=1.0, spin_deg=spin_deg))
    assert found.rx_deg[0] == pytest.approx(1.0, abs=1e-9)
    assert found.ry_deg[0] == pytest.approx(0.0, abs=1e-9)
    assert found.tilt_deg[0] == pytest.approx(1.0, abs=1e-9)


def test_signs_follow_the_truths_own_axes():
    found = one(CAMERA, CAMERA @ turned(x_deg=-2.0, y_deg=3.0, spin_deg=50, t_mm=(1.0, -2.0, 0.5)))
    assert (found.rx_deg[0], found.ry_deg[0]) == pytest.approx((-2.0, 3.0), abs=1e-9)
    assert (found.tx_mm[0], found.ty_mm[0], found.tz_mm[0]) == pytest.approx((1.0, -2.0, 0.5), abs=1e-9)
    assert found.lateral_mm[0] == pytest.approx(np.sqrt(5.0), abs=1e-9)
    assert found.axial_mm[0] == pytest.approx(0.5, abs=1e-9)


def test_upside_down_has_an_angle_and_no_parts_per_axis():
    found = one(CAMERA, CAMERA @ turned(x_deg=180.0))
    assert found.tilt_deg[0] == pytest.approx(180.0, abs=1e-6)
    assert np.isnan(found.rx_deg[0])
    assert np.isnan(found.ry_deg[0])
    assert np.isfinite(one(CAMERA, CAMERA @ turned(x_deg=89.9)).rx_deg[0])


def test_the_same_pose_has_no_error():
    found = one(CAMERA, CAMERA)
    assert [getattr(found, axis)[0] for axis in AXES] == pytest.approx([0.0] * 6, abs=1e-9)
    assert mssd_mm(CAMERA[None], CAMERA[None], PROFILE)[0] == pytest.approx(0.0, abs=1e-4)
    assert add_s_mm(CAMERA[None], CAMERA[None], PROFILE)[0] == pytest.approx(0.0, abs=1e-9)


def test_a_missing_pose_gives_nan_beside_a_good_one():
    truth = np.stack([CAMERA, CAMERA])
    estimate = np.stack([np.full((4, 4), np.nan), CAMERA @ turned(y_deg=1.0)])
    found = pose_errors(truth, estimate)
    assert np.isnan([getattr(found, axis)[0] for axis in AXES]).all()
    assert found.ry_deg[1] == pytest.approx(1.0, abs=1e-9)
    assert np.isnan(mssd_mm(truth, estimate, PROFILE)[0])


def test_arrays_of_other_shapes_are_refused():
    with pytest.raises(ValueError, match=r"expected two arrays of shape \(N, 4, 4\)"):
        pose_errors(CAMERA, CAMERA)


angles = st.floats(-40, 40)
spins = st.floats(-360, 360)


@given(x_deg=angles, y_deg=angles, spin_deg=spins)
@settings(max_examples=100)
def test_swing_gives_back_the_rotation_vector_for_any_spin(x_deg, y_deg, spin_deg):
    found = one(CAMERA, CAMERA @ turned(x_deg, y_deg, spin_deg))
    assert (found.rx_deg[0], found.ry_deg[0]) == pytest.approx((x_deg, y_deg), abs=1e-6)
    assert found.tilt_deg[0] == pytest.approx(np.hypot(x_deg, y_deg), abs=1e-6)


@given(spin_deg=spins, x_deg=angles)
@settings(max_examples=10)
def test_surface_distances_do_not_see_the_spin(spin_deg, x_deg):
    plain, spun = CAMERA @ turned(x_deg, 1.0, 0.0, (1, 2, 3)), CAMERA @ turned(x_deg, 1.0, spin_deg, (1, 2, 3))
    for distance in (mssd_mm, add_s_mm):
        assert distance(CAMERA[None], plain[None], PROFILE) == pytest.approx(
            distance(CAMERA[None], spun[None], PROFILE), abs=1e-6
        )


def test_moving_the_camera_changes_no_error():
    T_estimate = turned(0.7, -0.4, 80, (0.3, -0.6, 1.0))
    here, there = (np.eye(4), T_estimate), (CAMERA, CAMERA @ T_estimate)
    for axis in AXES:
        assert getattr(one(*here), axis) == pytest.approx(getattr(one(*there), axis), abs=1e-9)
    for distance in (mssd_mm, add_s_mm):
        near, far = (distance(truth[None], estimate[None], PROFILE)[0] for truth, estimate in (here, there))
        assert near == pytest.approx(far, abs=1e-6)


def test_one_degree_at_the_cap_is_two_sines_of_half_the_angle():
    found = pose_errors(CAMERA[None], (CAMERA @ turned(x_deg=1.0))[None], np.array([0.107]))
    assert np.isnan(one(CAMERA, CAMERA).cap_mm[0])
    assert found.cap_mm[0] == pytest.approx(2 * 107 * np.sin(np.deg2rad(0.5)), abs=1e-9)


def test_surface_distances_of_a_plain_shift():
    up, aside = ((CAMERA @ turned(t_mm=t_mm))[None] for t_mm in ((0, 0, 2), (2, 0, 0)))
    assert mssd_mm(CAMERA[None], up, PROFILE)[0] == pytest.approx(2.0, abs=1e-3)
    assert mssd_mm(CAMERA[None], aside, PROFILE)[0] == pytest.approx(2.0, abs=0.01)
    wall = np.array([[0.0, 0.008], [0.1, 0.008]])
    # Up along a cylinder's wall, only what stands above the old rim is off it: 2 mm of 100, 1 mm on average.
    assert add_s_mm(CAMERA[None], up, wall)[0] == pytest.approx(0.02, abs=0.005)
    # Aside, the wall's distance is |2 cos phi| to first order: 4 / pi on average.
    assert add_s_mm(CAMERA[None], aside, wall)[0] == pytest.approx(4 / np.pi, abs=0.15)


def test_add_s_weighs_by_area():
    disc, turn = np.array([[0.0, 0.0], [0.0, 0.02]]), turned(x_deg=1.0)
    # |y| sin(1 deg), averaged over the area of a disc: 4 R / (3 pi).
    expected = 4 * 20 / (3 * np.pi) * np.sin(np.deg2rad(1.0))
    assert add_s_mm(np.eye(4)[None], turn[None], disc)[0] == pytest.approx(expected, rel=0.02)


def test_mssd_is_the_least_over_a_fine_search_of_spins():
    T = turned(1.5, -0.5, 0.0, (1.0, -0.5, 2.0))
    phi = np.linspace(0, 2 * np.pi, 360, endpoint=False)
    z, r = PROFILE[:, 0, None], PROFILE[:, 1, None]
    points = np.stack([r * np.cos(phi), r * np.sin(phi), z + 0 * phi], axis=-1).reshape(-1, 3)
    moved = points @ T[:3, :3].T + T[:3, 3]
    spins = Rotation.from_euler("z", np.linspace(-20, 20, 81)[:, None], degrees=True)
    slow = min(np.linalg.norm(moved - points @ spin.as_matrix().T, axis=1).max() for spin in spins) * 1e3
    found = mssd_mm(np.eye(4)[None], T[None], PROFILE)[0]
    assert found == pytest.approx(slow, rel=2e-3)
    assert found <= slow + 1e-3
    still = np.linalg.norm(moved - points, axis=1).max() * 1e3
    assert slow < still - 0.005


def pose(T):
    return dict(zip(("tx_m", "ty_m", "tz_m", "qw", "qx", "qy", "qz"), (*T[:3, 3], *quaternion_wxyz(T)), strict=True))


def truth_row(trial, slot, tube="chen2023-tube-1", status="ok", T=CAMERA):
    return {"session": "s", "trial": trial, "slot": slot, "tube": tube, "status": status, **pose(T)}


def estimate_row(
    trial, slot, method="paper", T=CAMERA, tube="chen2023-tube-1", status="ok", seed=pd.NA, confidence=1.0, frame=0
):
    at = pose(T) if T is not None else dict.fromkeys(pose(CAMERA), np.nan)
    return {
        "session": "s", "trial": trial, "capture": f"{trial}-original", "frame": frame,
        "timestamp_ns": 1_700_000_000_000_000_001, "method": method, "seed": seed, "slot": slot, "tube": tube,
        "status": status, "reason": "", "confidence": confidence, **at, "tilt_deg": 0.0, "n_points": 100,
    }  # fmt: skip


def table(rows):
    columns = list(estimate_row("a", "A1"))
    return pd.DataFrame(rows, columns=columns).astype({"seed": "Int64", "timestamp_ns": "Int64"})


TRUTH = pd.DataFrame(
    [
        truth_row("a", "A1"),
        truth_row("a", "A2"),
        truth_row("a", "A3", "chen2023-tube-2"),
        truth_row("a", "A4", status="refused"),
        truth_row("b", "A1"),
        truth_row("b", "A2"),
    ]
)


def outcomes(errors, **keys):
    for name, value in keys.items():
        errors = errors[errors[name] == value]
    return errors["outcome"].tolist()


def test_every_expected_tube_has_exactly_one_row_and_one_outcome():
    estimates = table(
        [
            estimate_row("a", "A1", T=CAMERA @ turned(x_deg=1.0, spin_deg=77)),
            estimate_row("a", "A2", T=CAMERA @ turned(y_deg=30.0), status="rejected"),
            estimate_row("a", "A3", T=None, status="failed"),
            estimate_row("a", "A4"),
            estimate_row("a", "B9"),
            estimate_row("a", None, status="rejected", T=None),
            estimate_row("b", "A1", T=CAMERA @ turned(x_deg=170.0)),
        ]
    )
    errors = evaluate(estimates, TRUTH, TUBES, ["paper"])
    assert tuple(errors.columns) == ERROR_COLUMNS
    assert outcomes(errors, trial="a", slot="A1") == ["ok"]
    assert outcomes(errors, trial="a", slot="A2") == ["rejected"]
    assert outcomes(errors, trial="a", slot="A3") == ["failed"]
    assert outcomes(errors, trial="a", slot="A4") == []
    assert outcomes(errors, trial="a", slot="B9") == ["false"]
    assert outcomes(errors, trial="b", slot="A1") == ["failed"]
    assert outcomes(errors, trial="b", slot="A2") == ["missed"]
    assert len(errors) == 6
    rejected = errors[errors["outcome"] == "rejected"].iloc[0]
    assert rejected["ry_deg"] == pytest.approx(30.0)
    assert errors.loc[errors["outcome"] == "missed", "capture"].tolist() == ["b-original"]
    assert errors.loc[errors["reason"] == "upside down", "tilt_deg"].tolist() == pytest.approx([170.0])


def test_counts_add_up_and_rejected_errors_stay_out_of_the_means():
    estimates = table(
        [
            estimate_row("a", "A1", T=CAMERA @ turned(x_deg=1.2)),
            estimate_row("b", "A1", T=CAMERA @ turned(x_deg=-3.0, t_mm=(0.2, 0, 0))),
            estimate_row("a", "A2", T=CAMERA @ turned(x_deg=30.0), status="rejected"),
            estimate_row("a", "C1", tube="chen2023-tube-2"),
        ]
    )
    summary = summarise(evaluate(estimates, TRUTH, TUBES, ["paper", "upright"]))
    parts = summary[["n_ok", "n_rejected", "n_missed", "n_failed"]].sum(axis=1)
    assert (parts == summary["n_expected"]).all()
    assert summary["method"].tolist() == ["paper", "paper", "upright", "upright"]
    assert summary["n_expected"].tolist() == [4, 1, 4, 1]
    row = summary.iloc[0]
    assert (row["n_ok"], row["n_rejected"], row["n_missed"], row["n_failed"]) == (2, 1, 1, 0)
    assert row["rx_deg_mean"] == pytest.approx(2.1)
    assert row["rx_deg_bias"] == pytest.approx(-0.9)
    assert row["rx_deg_median"] == pytest.approx(2.1)
    assert row["rx_deg_p95"] == pytest.approx(2.91)
    assert row["rx_deg_max"] == pytest.approx(3.0)
    recalls = [row[f"recall_{limit}mm_{limit}deg"] for limit in ("0.5", "1", "2", "5")]
    assert recalls == [0.0, 0.0, 0.25, 0.5]
    assert summary["n_false"].tolist() == [0, 1, 0, 0]
    assert np.isnan(summary.iloc[2]["rx_deg_mean"])
    assert summary.iloc[2]["n_missed"] == 4


def test_summary_begins_with_the_promised_columns():
    summary = summarise(evaluate(table([estimate_row("a", "A1")]), TRUTH, TUBES, ["paper"]))
    promised = ["method", "tube", "n_expected", "n_ok", "n_rejected", "n_missed", "n_failed"]
    promised += [f"{axis}_{end}" for axis in AXES for end in ("mean", "median", "p95", "bias")]
    assert summary.columns[: len(promised)].tolist() == promised


def test_the_methods_come_in_the_callers_order():
    estimates = table([estimate_row("a", "A1", method) for method in ("upright", "paper")])
    assert evaluate(estimates, TRUTH, TUBES, ["upright", "paper"])["method"].unique().tolist() == ["upright", "paper"]
    errors = evaluate(estimates, TRUTH, TUBES, ["paper", "upright"])
    assert summarise(errors)["method"].unique().tolist() == ["paper", "upright"]
    assert summarise(errors, ["upright", "paper"])["method"].unique().tolist() == ["upright", "paper"]
    assert set(evaluate(estimates, TRUTH, TUBES, ["paper"])["method"]) == {"paper"}


def test_a_capture_that_a_seed_did_not_finish_counts_as_missed():
    rows = [estimate_row("a", "A1", "global-icp", seed=seed) for seed in (0, 1)]
    rows += [estimate_row("b", "A1", "global-icp", seed=0)]
    errors = evaluate(table(rows), TRUTH, TUBES, ["global-icp"])
    assert len(errors) == 10
    assert outcomes(errors, trial="b", slot="A1", seed=0) == ["ok"]
    assert outcomes(errors, trial="b", slot="A1", seed=1) == ["missed"]
    assert errors["seed"].dtype == "Int64"
    assert summarise(errors)["n_seeds"].tolist() == [2, 2]


def test_no_estimates_at_all_are_missed_tubes():
    errors = evaluate(table([]), TRUTH, TUBES, ["paper"])
    assert outcomes(errors) == ["missed"] * 5
    assert errors["seed"].isna().all()


def test_the_second_accepted_estimate_in_a_slot_is_false_and_the_higher_confidence_counts():
    rows = [
        estimate_row("a", "A1", T=CAMERA @ turned(x_deg=5.0), confidence=0.2),
        estimate_row("a", "A1", T=CAMERA @ turned(x_deg=1.0), confidence=0.9),
        estimate_row("a", "A1", T=CAMERA @ turned(x_deg=0.0), confidence=0.99, status="rejected"),
    ]
    errors = evaluate(table(rows), TRUTH, TUBES, ["paper"])
    here = errors[errors["slot"] == "A1"]
    assert sorted(outcomes(here, trial="a")) == ["false", "ok"]
    assert here.loc[here["outcome"] == "ok", "rx_deg"].tolist() == pytest.approx([1.0])


def test_what_is_right_is_within_two_degrees_and_two_millimetres_and_of_its_type():
    def right(T=CAMERA, std_along_m=1e-4, **more):
        row = estimate_row("a", "A1", T=T, **more)
        errors = evaluate(table([row]).assign(cov_tz_tz=std_along_m**2), TRUTH, TUBES, ["paper"])
        return errors.loc[(errors["trial"] == "a") & (errors["slot"] == "A1"), "right"].tolist()

    up = CAMERA @ translation([0, 0, 2.1e-3])
    assert right() == right(T=CAMERA @ turned(x_deg=1.9)) == [True]
    assert right(T=CAMERA @ turned(x_deg=2.1)) == right(T=CAMERA @ translation([2.1e-3, 0, 0])) == [False]
    # Along the axis it counts where that is known.
    assert right(T=up) == [False]
    assert right(T=up, std_along_m=1.1e-3) == [True]
    assert right(tube="chen2023-tube-2") == [False]
    assert evaluate(table([]), TRUTH, TUBES, ["paper"])["right"].isna().all()


def test_an_accepted_estimate_in_no_slot_is_false():
    errors = evaluate(table([estimate_row("a", None), estimate_row("a", None)]), TRUTH, TUBES, ["paper"])
    assert outcomes(errors).count("false") == 2
    assert errors.loc[errors["outcome"] == "false", list(AXES)].isna().all(axis=None)


def test_a_trial_is_judged_on_its_first_frame_and_trials_without_truth_are_left_out():
    rows = [
        estimate_row("a", "A1", T=CAMERA @ turned(x_deg=2.0), frame=4),
        estimate_row("a", "A1", frame=5),
        estimate_row("z", "A1"),
    ]
    errors = evaluate(table(rows), TRUTH, TUBES, ["paper"])
    assert errors.loc[errors["outcome"] == "ok", "rx_deg"].tolist() == pytest.approx([2.0])
    assert "z" not in set(errors["trial"])
    assert "false" not in outcomes(errors)


def test_a_wrong_tube_type_is_told_and_counted():
    rows = [estimate_row("a", "A1", tube="chen2023-tube-2"), estimate_row("a", "A2")]
    errors = evaluate(table(rows), TRUTH, TUBES, ["paper"]).set_index(["trial", "slot"])
    assert not errors.loc[("a", "A1"), "type_correct"]
    assert errors.loc[("a", "A2"), "type_correct"]
    assert pd.isna(errors.loc[("b", "A1"), "type_correct"])
    summary = summarise(errors.reset_index())
    assert summary["n_wrong_type"].tolist() == [1, 0]


def test_an_unknown_status_is_a_broken_invariant():
    with pytest.raises(ValueError, match="expected status ok, rejected or failed, found fine"):
        evaluate(table([estimate_row("a", "A1", status="fine")]), TRUTH, TUBES, ["paper"])


def test_inputs_stay_as_they_were():
    estimates = table([estimate_row("b", "A2"), estimate_row("a", "A1", frame=1)])
    before, truth_before = estimates.copy(deep=True), TRUTH.copy(deep=True)
    summarise(evaluate(estimates, TRUTH, TUBES, ["paper"]))
    pd.testing.assert_frame_equal(estimates, before)
    pd.testing.assert_frame_equal(TRUTH, truth_before)


@functools.cache
def made(seed=0, trials=12):
    """Trials with one tube; `paper` is off by 0.5 deg, `global-icp` (2 seeds) by 1.5 deg, both with noise."""
    rng = np.random.default_rng(seed)
    truth = pd.DataFrame([truth_row(f"t{i:02}", "A1") for i in range(trials)])
    rows = []
    for i in range(trials):
        rows.append(estimate_row(f"t{i:02}", "A1", T=CAMERA @ turned(x_deg=0.5 + rng.normal(0, 0.05))))
        for s in (0, 1):
            T = CAMERA @ turned(x_deg=-1.5 - 0.1 * s + rng.normal(0, 0.05))
            rows.append(estimate_row(f"t{i:02}", "A1", "global-icp", T=T, seed=s))
    return evaluate(table(rows), truth, TUBES, ["paper", "global-icp"])


def many():
    return made().copy(deep=True)


def test_compare_finds_a_known_difference_of_absolute_errors():
    found = compare(many(), "paper").set_index("error")
    row = found.loc["rx_deg"]
    assert (row["method"], row["reference"], row["n_pairs"], row["n_captures"]) == ("global-icp", "paper", 12, 12)
    assert row["mean_difference"] == pytest.approx(1.05, abs=0.06)
    assert row["ci95_low"] < row["mean_difference"] < row["ci95_high"]
    assert row["ci95_low"] > 0.9
    assert found.loc["ty_mm", "mean_difference"] == pytest.approx(0.0, abs=1e-9)
    pd.testing.assert_frame_equal(compare(many(), "paper"), compare(many(), "paper"))


def test_compare_uses_only_tubes_that_both_accepted():
    errors = many()
    errors.loc[(errors["method"] == "paper") & (errors["trial"] == "t00"), "outcome"] = "rejected"
    assert compare(errors, "paper")["n_pairs"].unique().tolist() == [11]
    errors.loc[errors["method"] == "paper", "outcome"] = "failed"
    alone = compare(errors, "paper")
    assert alone["n_pairs"].unique().tolist() == [0]
    assert alone["mean_difference"].isna().all()


def test_seed_spread_shows_the_range_of_the_means_of_stochastic_methods_only():
    spread = seed_spread(many())
    assert spread["method"].tolist() == ["global-icp"]
    row = spread.iloc[0]
    assert (row["n_seeds"], row["n_ok_min"], row["n_ok_max"]) == (2, 12, 12)
    assert row["rx_deg_mean_min"] == pytest.approx(1.5, abs=0.05)
    assert row["rx_deg_mean_max"] == pytest.approx(1.6, abs=0.05)
    assert seed_spread(evaluate(table([]), TRUTH, TUBES, ["paper"])).empty


def test_a_summary_of_nothing_keeps_its_columns():
    estimates = table([estimate_row("a", "A1")])
    refused = evaluate(estimates, TRUTH.assign(status="refused"), TUBES, ["paper"])
    assert len(refused) == 0
    judged = evaluate(estimates, TRUTH, TUBES, ["paper"])
    assert summarise(refused, ["paper"]).columns.tolist() == summarise(judged).columns.tolist()
    assert len(summarise(refused, ["paper"])) == 0


def test_the_first_frame_is_judged_whatever_was_found_in_it():
    truth = table([truth_row("t", "A1")])
    estimates = table([estimate_row("t", "A1", method="profile", frame=1), estimate_row("t", "A1", frame=1)])
    racks = pd.DataFrame([{"session": "s", "trial": "t", "method": "profile", "frame": frame} for frame in (0, 1)])
    alone = evaluate(estimates, truth, TUBES, ["profile"], racks=racks)
    both = evaluate(estimates, truth, TUBES, ["profile", "paper"], racks=racks)
    assert alone["outcome"].tolist() == ["missed"]
    assert both["outcome"].tolist() == ["missed", "missed"]
    assert evaluate(estimates, truth, TUBES, ["profile"], racks=racks[1:])["outcome"].tolist() == ["ok"]


def test_a_seed_that_answered_nothing_is_counted():
    truth = table([truth_row("t", "A1")])
    estimates = table([estimate_row("t", "A1", method="global-icp", seed=0)])
    errors = evaluate(estimates, truth, TUBES, ["global-icp", "paper"], seeds={"global-icp": range(3)})
    assert errors["outcome"].tolist() == ["ok", "missed", "missed", "missed"]
    assert errors["seed"].tolist() == [0, 1, 2, pd.NA]
