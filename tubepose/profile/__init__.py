"""The default estimator: tubes from their whole profile and their slots, all of a frame at once (docs/method.md)."""

from tubepose.profile.bowed import FaceBow
from tubepose.profile.estimate import ProfileTube, fit_profiles

__all__ = ["FaceBow", "ProfileTube", "fit_profiles"]
