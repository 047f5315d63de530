"""What real cameras make of ideal views: shutter, shake, lens faults, sensor, automatics, compression, timing."""
