"""Robust fits: RANSAC, robust kernels, and one nonlinear least-squares solver."""
