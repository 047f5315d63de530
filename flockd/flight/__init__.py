"""The decisions: pure code from frames to a gated setpoint, without clock, thread or file."""
