"""Does it survive: faults, fuzzing, mutants, PX4, devices."""
