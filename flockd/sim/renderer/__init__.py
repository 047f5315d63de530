"""Draws camera images on the CPU: colour, exact metric depth, and which drone each pixel shows."""
