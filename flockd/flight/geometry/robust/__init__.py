"""Fits that outliers do not move: RANSAC, robust kernels, and one nonlinear least-squares solver, used by all."""
