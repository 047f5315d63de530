"""The result of a flight: figures in tables, curves and pages, beside the paper's own."""
