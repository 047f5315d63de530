"""The words: messages, choices, errors, configuration and shipped files."""
