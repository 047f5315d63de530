"""A worker and its deadlines; a network that would run for ever on its golden input is ended, and refused."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from onnx import TensorProto, helper

from flockd.core.errors import ModelError
from flockd.flight.inference import OnnxModel
from flockd.onboard.worker import BusyError, LateError, Worker, within
from tests.flight.inference.foreign import SIZE, image_input, map_output, write_model


def endless(folder: Path) -> Path:
    """A flow network that adds 0 to the difference of its images, 2^62 times."""
    width, height = SIZE
    image, flow = [1, height, width, 1], [1, height, width, 2]
    body = helper.make_graph(
        [
            helper.make_node("Add", ["carried", "nothing"], ["next"]),
            helper.make_node("Identity", ["go"], ["go_on"]),
        ],
        "body",
        [
            helper.make_tensor_value_info("number", TensorProto.INT64, []),
            helper.make_tensor_value_info("go", TensorProto.BOOL, []),
            helper.make_tensor_value_info("carried", TensorProto.FLOAT, flow),
        ],
        [
            helper.make_tensor_value_info("go_on", TensorProto.BOOL, []),
            helper.make_tensor_value_info("next", TensorProto.FLOAT, flow),
        ],
    )
    nodes = [
        helper.make_node("Sub", ["a", "b"], ["difference"]),
        helper.make_node("Add", ["difference", "nothing"], ["begin"]),
        helper.make_node("Loop", ["count", "true", "begin"], ["motion"], body=body),
    ]
    spec = image_input(shape=image, layout="nhwc", colour="grey", white=255.0)
    return write_model(
        folder, "endless", "flow", nodes,
        inputs={"a": {**spec, "carries": "first"}, "b": {**spec, "carries": "second"}},
        outputs={"motion": map_output(flow, layout="nhwc", gives="flow", unit="px")}, golden=False,
        weights={"count": np.array(2**62, np.int64), "true": np.array(True), "nothing": np.zeros(2, np.float32)},
    )  # fmt: skip


@pytest.mark.fault("endless-network")
def test_an_endless_network_is_refused_in_one_sentence(tmp_path: Path) -> None:
    path = endless(tmp_path)
    with pytest.raises(
        ModelError,
        match=rf"^{path}:4: file: endless\.onnx did not finish the golden input in time \(more than 0\.3",
    ):
        OnnxModel(path, threads=1, deadline=within(0.3))


def test_work_that_ends_in_time_is_not_stopped_and_passes_its_errors_on() -> None:
    def break_down() -> None:
        raise FloatingPointError("not finite")

    stopped: list[bool] = []
    within(5.0)(lambda: None, lambda: stopped.append(True))
    with pytest.raises(FloatingPointError, match="not finite"):
        within(5.0)(break_down, lambda: stopped.append(True))
    assert not stopped


@pytest.mark.parametrize("obeys", [True, False])
def test_work_that_takes_too_long_is_stopped_and_left_if_it_does_not_obey(obeys: bool) -> None:
    asked, free = threading.Event(), threading.Event()

    def work() -> None:
        (asked if obeys else free).wait()

    stop: Callable[[], None] = asked.set
    with pytest.raises(TimeoutError, match=r"more than 0\.1 s"):
        within(0.1)(work, stop)
    assert asked.is_set()
    assert not free.is_set(), "nobody waits for it"
    free.set()


def test_a_worker_answers_passes_errors_on_and_is_not_kept_by_a_job_that_hangs() -> None:
    hang = threading.Event()

    async def story() -> None:
        worker = Worker("test")
        assert await worker.do(5.0, divmod, 7, 2) == (3, 1)
        with pytest.raises(ZeroDivisionError):
            await worker.do(5.0, divmod, 7, 0)
        with pytest.raises(TimeoutError, match="the job's own"):
            await worker.do(5.0, _raises_timeout)
        with pytest.raises(LateError, match=r"test: not done within 0\.05 s"):
            await worker.do(0.05, hang.wait)
        worker.submit(hang.wait)
        with pytest.raises(BusyError, match="test: too many jobs wait"):
            worker.submit(hang.wait)
        hang.set()
        worker.leave()

    asyncio.run(story())


def _raises_timeout() -> None:
    raise TimeoutError("the job's own")
