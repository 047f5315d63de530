"""What all rooms share: messages, choices, errors, configuration and shipped files."""
