"""Inputs that nobody would write, against every place where flockd reads what comes from outside."""
