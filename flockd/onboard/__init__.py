"""The process on the drone: time, devices, threads and failures."""
