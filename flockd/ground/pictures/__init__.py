"""Single-frame detection in pictures of any origin: finding and reading them, detecting, scoring, drawing."""
