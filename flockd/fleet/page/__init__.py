"""The fleet page: shows a fleet in a browser from its telemetry, and sends commands."""
