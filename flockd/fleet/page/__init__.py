"""The fleet page: the flock in a browser, live from its telemetry or from recordings, and commands to it."""
