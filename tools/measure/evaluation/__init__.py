"""How good the shipped networks are, on worlds that they never saw."""
