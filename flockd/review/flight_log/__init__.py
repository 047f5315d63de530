"""What a flight was: its metadata, its log step by step, its key frames, and how estimates match the truth.

The simulator and recordings fill a flight log; reports read it. Nothing here imports the simulator or the reports.
"""
