"""What is known of every tube's pose: what was measured of its top and wall, and what its slot allows.

Unknowns of a tube, in its slot's frame (rack axes, origin on the slot floor's centre): where the point that the floor
holds (a round bottom's centre, or the tip) stands, (u, v), and the slope of the axis, (a, b) = (dx/dz, dy/dz).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.stats import norm, qmc

from tubepose.config import ProfileConfig
from tubepose.labware import RackModel, SlotModel, TubeModel
from tubepose.profile.fit_kernels import weighted_samples
from tubepose.transforms import FloatArray

SAMPLES = 256
FEW_SAMPLES = 64
"""Enough for a place at which walls are looked at."""


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """Gaussian measurements of the four unknowns as information, T tubes.

    Attributes:
        matrix: Information matrix over (u, v, a, b), shape (T, 4, 4); metres and slopes.
        vector: Information vector, shape (T, 4).
    """

    matrix: FloatArray
    vector: FloatArray

    def __add__(self, other: Evidence) -> Evidence:
        return Evidence(self.matrix + other.matrix, self.vector + other.vector)


@dataclass(frozen=True, slots=True, eq=False)
class Posterior:
    """Poses and how well they are known, T tubes.

    Attributes:
        mean: (u, v, a, b), shape (T, 4).
        covariance: Shape (T, 4, 4).
        allowed: Share of what the measurements leave open that the slot allows, shape (T,): near 0 where a tube stands
            or leans as its slot does not let it.
    """

    mean: FloatArray
    covariance: FloatArray
    allowed: FloatArray


def per_model(models: Sequence[TubeModel], value: Callable[[TubeModel], object]) -> FloatArray:
    """A value of every tube's model, computed once per model, as an array."""
    keys = [*map(id, models)]
    values = {key: value(model) for key, model in dict(zip(keys, models, strict=True)).items()}
    return np.array([*map(values.__getitem__, keys)], dtype=float)


def no_evidence(count: int) -> Evidence:
    """Nothing measured."""
    return Evidence(np.zeros((count, 4, 4)), np.zeros((count, 4)))


def evidence(design: FloatArray, value: FloatArray, covariance: FloatArray) -> Evidence:
    """Measurements ``value = design x`` as information; rows with NaN say nothing.

    Args:
        design: Array of shape (T, K, 4).
        value: Array of shape (T, K).
        covariance: Array of shape (T, K, K).
    """
    known = np.asarray(np.isfinite(value).all(axis=1))
    filled = np.where(known[:, None, None], covariance, np.eye(value.shape[1]))
    weighted = np.linalg.solve(filled, design) * known[:, None, None]
    vector = np.einsum("tki,tk->ti", weighted, np.nan_to_num(value))
    return Evidence(np.einsum("tki,tkj->tij", weighted, design), vector)


def combine(
    measured: Evidence,
    slots: Sequence[SlotModel],
    tubes: Sequence[TubeModel],
    rack: RackModel,
    config: ProfileConfig,
    samples: int = SAMPLES,
) -> Posterior:
    """Posterior mean and covariance under the slot's prior.

    The prior is what can be: the held point anywhere on the disc of the rack's floor play, the body anywhere inside the
    slot's walls; both have soft edges of `slot_tolerance_m`. It is no Gaussian: a Gaussian of about its size and the
    measurements give a proposal, whose fixed quasi-random samples are weighted by the prior over that Gaussian.
    """
    play = np.full(len(tubes), max(rack.floor_play_mm * 1e-3, 0.2e-3))
    spread = np.array(
        [play / 2, play / 2, np.full_like(play, config.slope_std), np.full_like(play, config.slope_std)]
    ).T
    prior = np.zeros((len(tubes), 4, 4))
    prior[:, range(4), range(4)] = spread**-2.0
    covariance = np.linalg.inv(measured.matrix + prior)
    mean = np.einsum("tij,tj->ti", covariance, measured.vector)
    root = np.linalg.cholesky(covariance)
    # A straight body with a straight taper in a convex slot is inside if it is at both ends of what is inside: at the
    # held point and at the rack's top. The slot's own tolerance at its floor is the floor's play.
    ends = per_model(tubes, lambda tube: (tube.pivot_height_m, min(rack.depth_m, tube.height_m))).reshape(-1, 2)
    radii = per_model(tubes, lambda tube: tube.body_radius_m(np.array([tube.pivot_height_m, rack.depth_m])))
    openings = np.array([(*slot.size_mm, slot.corner_radius_mm, slot.shape == "round") for slot in slots], float)
    openings = openings.reshape(-1, 4) * (0.5e-3, 0.5e-3, 1e-3, 1.0)
    middle, scatter, allowed = weighted_samples(
        mean, root, _normal_samples(samples), spread, play, openings, ends - ends[:, :1], radii.reshape(-1, 2),
        config.slot_tolerance_m / 1.7,
    )  # fmt: skip
    # Where hardly a sample is left its scatter says nothing: at least a tenth of what the measurements leave.
    return Posterior(middle, scatter + 0.01 * covariance, allowed)


@lru_cache(maxsize=4)
def _normal_samples(count: int) -> FloatArray:
    """Quasi-random standard normal samples, shape (count, 4), always the same, with mean 0."""
    uniform = qmc.Sobol(4, scramble=True, rng=np.random.default_rng(0)).random(count // 2)
    half = norm.ppf(np.clip(uniform, 1e-6, 1 - 1e-6))
    return np.asarray(np.concatenate([half, -half]))
