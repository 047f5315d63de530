"""Examines a drone on the ground: each check says what it measured, whether that is well, and how to fix it."""

from flockd.ground.doctor.examination import CHECKS, Check, Examined, plan, run_checks
from flockd.ground.doctor.finding import Finding, Level, failed, passed, warned

__all__ = ["CHECKS", "Check", "Examined", "Finding", "Level", "failed", "passed", "plan", "run_checks", "warned"]
