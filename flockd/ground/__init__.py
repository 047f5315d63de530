"""Before a flight: cameras, calibration, doctor, datasets, pictures."""
