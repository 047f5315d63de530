"""A flock that flies live by sight: begun again it flies the same once more, and a camera that is off shows nothing."""

from __future__ import annotations

import pytest

from flockd.sim.flock.live_flight import LiveControls, fly_live
from flockd.sim.flock.swarm import eyes_of
from flockd.sim.vehicles.vehicles import UNDISTURBED, Disturbances
from tests import make
from tests.sim.flock.watching import Watching

STEPS = 2
FRONT_OFF = Disturbances(cameras_off=frozenset({(0, "front")}), removed=frozenset({1}))


class ThreeFlights(LiveControls):
    """As fast as they are computed: two undisturbed ones of a few steps, and one with a camera off and a drone gone."""

    flight = 0
    seen: Watching

    def begin(self) -> None:
        super().begin()
        self.flight += 1
        if self.flight == 2:
            assert sorted(self.seen.image) == ["drone1", "drone2"]

    def wait(self, time_s: float) -> bool:
        if self.flight == 3 and time_s == 1.0:
            raise KeyboardInterrupt
        return time_s < 0.5 * STEPS

    @property
    def disturbed(self) -> Disturbances:
        return FRONT_OFF if self.flight == 3 else UNDISTURBED


def test_a_flight_begun_again_is_the_same_and_a_camera_that_is_off_shows_nothing() -> None:
    overrides = {"duration_s": 5.0, "seed": 5, "drone.perception.flow": "dis"}
    flown = make.small_eyes(make.scenario(overrides, drones=2))
    watching, controls = Watching(), ThreeFlights(flown, "f10c", by_sight=True)
    controls.seen = watching
    with pytest.raises(KeyboardInterrupt):
        fly_live(flown, watching.shown(flown), controls, eyes_of(flown))
    of_one = 2 * STEPS
    first, again, disturbed = (watching.commands[begin : begin + of_one] for begin in (0, of_one, 2 * of_one))
    assert first == again, "the same world, the same noise, and pilots that know nothing of the first flight"
    assert [drone for drone, _ in disturbed] == ["drone1", "drone1"], "drone2 is not there any more"
    assert sorted(watching.image) == ["drone1"]
    assert (watching.image["drone1"]("front"), watching.image["drone1"]("back") is None) == (None, False)
    told = [reason["sentence"] for reason in watching.flights["drone1"][-1]["reasons"]]
    assert told[0].endswith("front unplugged")
    assert "camera front: no frame" in told
