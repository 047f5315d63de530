"""Which worlds and which drones are for what.

Training, validation and test worlds never meet; flights use seeds below all of them. Families are rows of
``flockd.sim.drone_models``: the unseen ones are left out of training, to test on drones that no network knows. Shapes
are those of ``tools.training.drone_generator``: training worlds have them besides the families.
"""

FLIGHTS = range(0, 1_000_000)
TRAINING = range(1_000_000, 2_000_000)
VALIDATION = range(2_000_000, 3_000_000)
TEST = range(3_000_000, 4_000_000)

FAMILIES = range(12)
UNSEEN_FAMILIES = range(12, 14)
SHAPES = range(400)
SHAPES_SHARE = 2 / 3
"""Of the drones of training worlds."""
