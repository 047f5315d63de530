"""What real cameras make of ideal views: shutter, shake, flare, noise, compression, timing."""
