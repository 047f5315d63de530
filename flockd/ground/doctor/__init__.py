"""Examines a drone on the ground: each check says what it measured, whether that is well, and how to fix it."""

from flockd.ground.doctor.finding import Finding, Level, failed, passed, warned
from flockd.ground.doctor.plan import CHECKS, plan
from flockd.ground.doctor.runner import Check, run_checks

__all__ = ["CHECKS", "Check", "Finding", "Level", "failed", "passed", "plan", "run_checks", "warned"]
