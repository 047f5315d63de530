"""Robust fits: RANSAC and robust kernels."""
