"""After a flight: its log, its replay and its report."""
