"""Examines a drone on the ground: each check says what it measured, whether that is well, and how to fix it."""

from flockd.ground.doctor.examination import (
    CHECKS,
    Check,
    Examined,
    Finding,
    Level,
    failed,
    passed,
    plan,
    run_checks,
    warned,
)

__all__ = ["CHECKS", "Check", "Examined", "Finding", "Level", "failed", "passed", "plan", "run_checks", "warned"]
