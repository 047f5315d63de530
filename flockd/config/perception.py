"""Which network or method fills which role, and what computes it."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from flockd.choices import ROLES, FlowRefinement, Provider, Role, ScaleSource
from flockd.config.base import Positive, Section

DIS, NO_MODEL = "dis", "none"
"""What stands where else a model's name does: OpenCV's DIS flow, and no second stage."""


class PerceptionConfig(Section):
    """Which model fills which role. A name is a manifest in `models_dir`, or a path to one that ends in `.yaml`.

    Relative paths count from the folder of the configuration file.
    """

    flow: str = "flow_int8"
    """`dis` is OpenCV's DIS flow instead of a network."""
    flow_refinement: FlowRefinement = "quick_dis"
    """A network's flow finds what moved far; DIS then makes it exact. `quick_dis` is for flight: 12 ms an image, where
    `dis` takes 34, and where the images show nothing, what is around tells the flow. With a sensor's depth, on images
    that are blurred and moved far, `dis` is worth its time, and every pixel keeps its own flow.
    """
    flow_refinement_scale: Annotated[int, Field(ge=0, le=5)] = 1
    """Where DIS after a network stops: at a 2^n-th of the size."""
    depth: str = "neighbours_int8"
    segmentation: str = "neighbours_int8"
    distance: str = "distance_int8"
    """Second stage: a drone's range from its crop alone. `none`: the depth map decides."""
    models_dir: str | None = None
    """Folder of the manifests; by default the one that comes with flockd."""
    threads: Annotated[int, Field(ge=1, le=64)] = 2
    provider: Provider = "cpu"
    """What ONNX Runtime computes with. Another one than this is never used in its place."""
    engines_dir: str | None = None
    """Where `flockd models prepare` keeps what a provider has built; by default `engines` beside the manifests."""
    deadline_s: Positive = 1.0
    """In flight, a network that has not finished one call by then is stuck, and is ended."""
    scale: ScaleSource = "height"
    """The background's metric scale: `network` (pure RGB, as in the paper), `height` (attitude and height above ground
    from the autopilot) or `velocity` (attitude and velocity from the autopilot; the drone has to move)."""

    @property
    def networks(self) -> dict[Role, str]:
        """The model's name, or its manifest's path, of each role that a network fills."""
        return {role: name for role in ROLES if (name := getattr(self, role)) not in {DIS, NO_MODEL}}
