"""Every closed choice of the configuration and the command line, spelled once; imports nothing heavy.

Where a choice is needed at run time, ``typing.get_args`` lists it.
"""

from __future__ import annotations

from typing import Literal, get_args

Role = Literal["flow", "depth", "segmentation", "detector", "distance", "verification"]
"""What a network is used for: optical flow of two images, depth of one, pixels of drones in one, boxes of drones in
one, range of the drone in a crop, and whether there is a drone in a crop."""
ROLES: tuple[Role, ...] = get_args(Role)
"""Those that a simulator can fill with the truth. True segments need no boxes, and the true distance also tells whether
there is a drone."""

Provider = Literal["cpu", "cuda", "tensorrt", "openvino"]
"""What computes the networks: execution providers of ONNX Runtime, or OpenVINO."""

FlowRefinement = Literal["lucas_kanade", "dis", "none"]
"""What sharpens a network's flow."""

ScaleSource = Literal["network", "height"]
"""Where the metric scale of the background comes from."""

HeightSource = Literal["range_finder", "barometer", "best"]
"""What measures the height above ground that fixes the background's scale."""

OwnVelocitySource = Literal["vision", "autopilot"]
"""Whose estimate of its own velocity a drone flies by."""

LensModel = Literal["pinhole", "wide_angle"]
"""A camera's projection: with OpenCV's radial-tangential distortion, or equidistant (Kannala-Brandt)."""
LENS_MODELS: tuple[LensModel, ...] = get_args(LensModel)

PixelFormat = Literal["mjpeg", "yuyv"]
"""What a V4L2 camera delivers."""

ImageFormat = Literal["png", "jpeg"]
"""How the images of a recording are compressed."""

AutopilotMode = Literal["hold", "return", "land"]
"""What flockd may ask the autopilot to do instead of following it."""

SimulatedPerception = Literal["learned", "truth"]
"""Whether a simulated drone flies by its networks or by the simulator's state."""

CameraPreset = Literal["ideal", "realistic"]
"""How good a simulated drone's cameras are."""

AutopilotKind = Literal["fake", "px4"]
"""Which autopilot a simulated fleet flies with."""
