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
from tubepose.batch.running import fill_tables, run_jobs, run_schedule
from tubepose.batch.schedule import Schedule
from tubepose.batch.tasks import Asked, Setup
from tubepose.batch.workers import Limits

__all__ = [
    "MOST_ASKED",
    "Asked",
    "DetectorFactory",
    "Job",
    "Limits",
    "RackFinder",
    "Schedule",
    "Setup",
    "UnnamedJob",
    "fill_tables",
    "run_jobs",
    "run_schedule",
    "session_jobs",
    "trial_capture",
]
