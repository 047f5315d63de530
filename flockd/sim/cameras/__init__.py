"""Real cameras: shutter, shake, flare, noise, compression and timing applied to ideal views."""
