"""Detection in pictures and videos of any origin: reading, detecting, tracking in videos, drawing."""
