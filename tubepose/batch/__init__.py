"""Many captures through the pipeline: what is asked, and the run."""

from tubepose.batch.jobs import (
    MOST_ASKED,
    DetectorFactory,
    Job,
    RackFinder,
    UnnamedJob,
    session_jobs,
    trial_capture,
)
from tubepose.batch.running import run_jobs

__all__ = [
    "MOST_ASKED",
    "DetectorFactory",
    "Job",
    "RackFinder",
    "UnnamedJob",
    "run_jobs",
    "session_jobs",
    "trial_capture",
]
