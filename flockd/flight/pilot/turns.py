"""Cameras by need: at short steps, sides where nothing is near are looked at in turn."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection

from flockd.core.messages import FloatArray
from flockd.flight.geometry import Rig
from flockd.flight.perception import Observation


class Turns:
    """Which cameras rest in a step.

    A camera with a place of interest in view never rests: a neighbour's, or where the drone flies. Another one rests
    for `longest_rest_s` at most, and no two that began together end together. Optical flow, and what judges a camera by
    it, needs pairs of images: after a rest a camera is looked at in two steps, and half of the cameras give flow in
    each step.
    """

    def __init__(self, rig: Rig, longest_rest_s: float, around_m: float) -> None:
        """A camera has a place in view if it images a point `around_m` beside it: places move, and are not exact."""
        self._rig, self._longest_rest_s, self._around_m = rig, longest_rest_s, around_m
        self._looked_s = dict.fromkeys(rig.cameras, -math.inf)

    def resting(
        self,
        time_s: float,
        with_image: Collection[str],
        last: Observation | None,
        places_body: Callable[[], FloatArray],
    ) -> frozenset[str]:
        """The cameras with an image that rest at `time_s`: none where two steps are longer than a rest.

        `last` is the observation before; `places_body` gives the places of interest (n, 3), metres, body FRD.
        """
        if last is None or not 0.0 < time_s - last.time_s < self._longest_rest_s:
            return frozenset()
        self._looked_s |= dict.fromkeys(last.cameras, last.time_s)
        next_s = 2.0 * time_s - last.time_s
        needed = set(self._rig.looking_at(places_body(), self._around_m))
        needed |= {name for name, one in last.cameras.items() if one.flow is None}
        resting_since_s = set[float]()
        for name in with_image:
            since_s = self._looked_s[name]
            if next_s - since_s > self._longest_rest_s or since_s in resting_since_s:
                needed.add(name)
            elif name not in needed:
                resting_since_s.add(since_s)
        half = len(self._rig.cameras) / 2
        before = [name for name in with_image if name in last.cameras]
        pairs = before if len(before) >= half else with_image
        for name in pairs:
            if len(needed.intersection(pairs)) < half:
                needed.add(name)
        return frozenset(with_image) - needed
