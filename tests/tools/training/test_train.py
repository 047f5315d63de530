"""How training samples are drawn beside the learning. Needs the extra `train`."""

from __future__ import annotations

from itertools import islice

import numpy as np
import pytest
from torch import nn

from tools.training.samples import Sample
from tools.training.tasks import Task
from tools.training.train import batches


class Numbers(Task):
    """Any number is a sample."""

    def __init__(self) -> None:
        super().__init__(nn.Linear(1, 1), 1, 1e-3)

    def sample(self, rng: np.random.Generator) -> Sample:
        """See ``Task``."""
        return {"number": np.array([rng.random()])}


def drawn(seed: list[int], workers: int) -> list[float]:
    return [float(batch["number"]) for batch in islice(batches(Numbers(), seed, workers), 6)]


@pytest.mark.parametrize("workers", [1, 2])
def test_every_batch_is_another_one_and_the_same_again_from_the_same_seed(workers: int) -> None:
    first = drawn([3, 0], workers)
    assert len(set(first)) == 6
    assert first == drawn([3, 0], workers)
    assert set(first).isdisjoint(drawn([3, 1], workers))
