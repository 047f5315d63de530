"""The libraries that compute networks, behind one interface: ONNX Runtime, and OpenVINO for Intel's processors."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import onnxruntime as ort
from numpy.typing import NDArray

if TYPE_CHECKING:
    import openvino

Arrays = Mapping[str, NDArray[Any]]
_Shape = tuple[int, ...]


class Runtime(Protocol):
    """A model opened by a library. ``run`` may be called from any thread."""

    provider: str
    """The provider that computes it, as the library reports."""

    def run(self, names: Sequence[str], feeds: Arrays) -> list[NDArray[Any]]:
        """Returns the outputs of these names. Raises errors of the library."""
        ...

    def terminate(self) -> None:
        """Ends the current runs, from any thread; they raise errors of the library."""
        ...


class OnnxRuntime:
    """A session of ONNX Runtime."""

    def __init__(self, session: ort.InferenceSession) -> None:
        self._session = session
        self._running: set[ort.RunOptions] = set()
        self.provider = str(session.get_providers()[0])

    def run(self, names: Sequence[str], feeds: Arrays) -> list[NDArray[Any]]:
        """See `Runtime`."""
        options = ort.RunOptions()
        self._running.add(options)
        try:
            outputs: list[NDArray[Any]] = self._session.run(list(names), dict(feeds), options)
        finally:
            self._running.discard(options)
        return outputs

    def terminate(self) -> None:
        """See `Runtime`."""
        for options in tuple(self._running):
            options.terminate = True


class OpenVino:
    """A model compiled by OpenVINO for each shape of its inputs: it takes two thirds of the time of free shapes."""

    provider = "OpenVINO"

    def __init__(self, path: Path, threads: int, folder: Path | None) -> None:
        """``threads``: for one run; ``folder``: for compiled models. Raises OpenVINO's errors."""
        import openvino  # noqa: PLC0415 - an extra

        self._core = openvino.Core()
        self._model = self._core.read_model(path)
        self._options: dict[str, Any] = {
            "INFERENCE_NUM_THREADS": threads,
            "NUM_STREAMS": 1,
            "ENABLE_CPU_PINNING": False,  # with it, simultaneous runs share the first core
            "INFERENCE_PRECISION_HINT": "f32",  # without it, some processors round to 16 bits
        }
        if folder is not None:
            self._options["CACHE_DIR"] = str(folder)
        self._idle: dict[tuple[_Shape, ...], list[openvino.InferRequest]] = {}
        self._running: set[openvino.InferRequest] = set()

    def run(self, names: Sequence[str], feeds: Arrays) -> list[NDArray[Any]]:
        """See `Runtime`."""
        with self._request({name: array.shape for name, array in feeds.items()}) as request:
            request.start_async(dict(feeds), share_inputs=True)  # `infer` cannot be cancelled
            request.wait()
            return [request.get_tensor(name).data.copy() for name in names]

    def terminate(self) -> None:
        """See `Runtime`."""
        for request in tuple(self._running):
            request.cancel()

    @contextmanager
    def _request(self, shapes: Mapping[str, _Shape]) -> Iterator[openvino.InferRequest]:
        """A request that no other thread uses: each one computes one run at a time."""
        idle = self._idle.setdefault(tuple(shapes.values()), [])
        try:
            request = idle.pop()
        except IndexError:  # all are in use
            request = self._compiled(shapes)
        self._running.add(request)
        try:
            yield request
        finally:
            self._running.discard(request)
            idle.append(request)

    def _compiled(self, shapes: Mapping[str, _Shape]) -> openvino.InferRequest:
        model = self._model.clone()
        model.reshape({name: list(shape) for name, shape in shapes.items()})
        return self._core.compile_model(model, "CPU", self._options).create_infer_request()
