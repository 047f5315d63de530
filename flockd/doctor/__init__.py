"""Examines a drone on the ground: each check says what it measured, whether that is well, and how to mend it."""

from flockd.doctor.examination import Check, examine
from flockd.doctor.finding import Finding, Level, failed, passed, warned
from flockd.doctor.plan import CHECKS, plan

__all__ = ["CHECKS", "Check", "Finding", "Level", "examine", "failed", "passed", "plan", "warned"]
