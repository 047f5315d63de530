"""Fine-tuning of the second stage for a fleet's own drone; the command is ``tools.training.specialise``."""
