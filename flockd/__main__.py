"""`python -m flockd`: the same as the installed `flockd`."""

from flockd import program

program()
