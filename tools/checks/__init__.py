"""Checks by hand and in CI: breakages, mutants, PX4, devices, long runs."""
