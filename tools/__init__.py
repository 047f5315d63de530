"""Training, benchmarks and checks of flockd; run from the checkout as `python -m tools.GROUP.NAME`."""
