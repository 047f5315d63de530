"""Draws what cameras see, on the CPU: colour, exact metric depth and who is where."""
