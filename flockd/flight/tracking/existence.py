"""Integrated probabilistic data association (IPDA): the probability that a track is of a drone.

D. Musicki, R. Evans, S. Stankovic, "Integrated probabilistic data association", IEEE Transactions on Automatic Control
39(6), 1994, with one measurement a track, as the assignment is hard. `weight` (0 to 1) is how much of an independent
frame set this one is: log likelihood ratios count by it.
"""

from __future__ import annotations

import math

import numpy as np

from flockd.core.config.tracking import TrackingParameters

_SUREST = 0.999
"""Limit of a network's probability of a drone, and of its complement."""


def begun(drone_probability: float, share: float, parameters: TrackingParameters) -> float:
    """The existence probability, 0 to 1, of a new track from one detection with this probability of a drone.

    Clutter is denser among doubtful and vague detections. So the odds are multiplied by the detection's odds over those
    that confirm a track, if these are higher, and by its ``share``, 0 to 1: the usual range sigma over its own.
    """
    doubt = _log_odds(drone_probability) - _log_odds(parameters.confirm_probability)
    return _bayes(parameters.birth_probability, min(doubt, 0.0) + math.log(share))


def missed(probability: float, in_view: float, weight: float, parameters: TrackingParameters) -> float:
    """After a frame set without a detection of the track, which the cameras show with the probability `in_view`."""
    return _bayes(probability, weight * math.log(1.0 - in_view * parameters.detection_probability))


def detected(
    probability: float, log_likelihood: float, weight: float, parameters: TrackingParameters, persists: float = 0.0
) -> float:
    """After a detection was assigned to the track: ``log_likelihood`` is compared with the density of clutter.

    A shadow or a bush is detected again where it was: with the probability ``persists`` clutter is where the track is
    expected.
    """
    chance = parameters.detection_probability
    clutter = math.log(parameters.clutter_density)
    if persists > 0.0:
        clutter = np.logaddexp(clutter, math.log(persists) + log_likelihood)
    log_ratio = np.logaddexp(math.log(1.0 - chance), math.log(chance) + log_likelihood - clutter)
    return _bayes(probability, weight * float(log_ratio))


def averaged(
    drone_probability: float, measured: float, hits: int, interval_s: float, parameters: TrackingParameters
) -> float:
    """The network's probability of a drone, averaged over the track's `hits` detections; `measured` is the newest.

    Log odds are averaged: they are the likelihood ratios of what the network sees, beside that of the place (D. Lerro,
    Y. Bar-Shalom, "Interacting multiple model tracking with target amplitude feature", IEEE Transactions on Aerospace
    and Electronic Systems 29(2), 1993). They are not added: a wrong network stays wrong from frame to frame, its
    probabilities are not independent, and Bayes' rule would turn them into certainty. The memory is exponential in
    time.
    """
    share = max(1.0 / hits, 1.0 - math.exp(-interval_s / parameters.drone_probability_memory_s))
    before, newest = _log_odds(drone_probability), _log_odds(measured)
    return 1.0 / (1.0 + math.exp(-before - share * (newest - before)))


def _log_odds(probability: float) -> float:
    within = min(max(probability, 1.0 - _SUREST), _SUREST)
    return math.log(within / (1.0 - within))


def _bayes(probability: float, log_likelihood_ratio: float) -> float:
    """The probability after evidence with this ratio of likelihoods, existence over absence."""
    return probability / (probability + (1.0 - probability) * math.exp(-log_likelihood_ratio))
