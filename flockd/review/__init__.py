"""After a flight: its log, replay, report and view."""
