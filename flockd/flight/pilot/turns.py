"""Cameras by need: at short steps, sides where nothing is near are looked at in turn."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection

from flockd.core.messages import FloatArray
from flockd.flight.geometry import Rig


class Turns:
    """Which cameras rest in a step.

    A camera with a place of interest in view never rests: a neighbour's, or where the drone flies. Another one rests
    for `longest_rest_s` at most, and no two that began together end together. The own motion needs pairs of images:
    half of the cameras are looked at in this step and were in the step before.
    """

    def __init__(self, rig: Rig, longest_rest_s: float, around_m: float) -> None:
        """A camera has a place in view if it images a point `around_m` beside it: places move, and are not exact."""
        self._rig, self._longest_rest_s, self._around_m = rig, longest_rest_s, around_m
        self._looked_s = dict.fromkeys(rig.cameras, -math.inf)
        self._time_s = -math.inf

    def resting(
        self, time_s: float, with_image: Collection[str], places_body: Callable[[], FloatArray]
    ) -> frozenset[str]:
        """The cameras with an image that rest at `time_s`: none where two steps are longer than a rest.

        `places_body` gives the places of interest (n, 3), metres, body FRD.
        """
        awake, interval_s = set(with_image), time_s - self._time_s
        if 0.0 < interval_s < self._longest_rest_s:
            awake &= self._needed(time_s + interval_s, with_image, places_body())
        self._time_s = time_s
        self._looked_s |= dict.fromkeys(awake, time_s)
        return frozenset(with_image) - awake

    def _needed(self, next_s: float, with_image: Collection[str], places_body: FloatArray) -> set[str]:
        """The cameras that may not rest until the next step."""
        half = len(self._rig.cameras) / 2
        before = [name for name in with_image if self._looked_s[name] == self._time_s]
        needed, resting_since_s = set(self._rig.looking_at(places_body, self._around_m)), set[float]()
        for name in with_image:
            since_s = self._looked_s[name]
            if next_s - since_s > self._longest_rest_s or since_s in resting_since_s:
                needed.add(name)
            elif name not in needed:
                resting_since_s.add(since_s)
        pairs = before if len(before) >= half else with_image
        for name in pairs:
            if len(needed.intersection(pairs)) < half:
                needed.add(name)
        return needed
