"""What a simulated flight came to: figures in tables, curves and pages, beside the paper's own."""
