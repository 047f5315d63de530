"""Many flights of one scenario: what varies is flown in processes or on a cluster, kept as tables, and reported."""
