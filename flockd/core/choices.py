"""Every closed choice of the configuration and the command line, spelled once; imports nothing heavy.

Where a choice is needed at run time, ``typing.get_args`` lists it.
"""

from __future__ import annotations

from typing import Literal, get_args

Role = Literal["flow", "depth", "segmentation", "detector", "distance", "verification"]
"""Roles of networks: optical flow; depth, pixels and boxes of drones; range of the drone in a crop; is there a
drone."""
ROLES: tuple[Role, ...] = get_args(Role)
"""Roles that a simulator can fill with the truth. True segments need no boxes, and the true distance also shows whether
there is a drone."""

Provider = Literal["cpu", "cuda", "tensorrt", "openvino"]
"""Providers that compute networks: those of ONNX Runtime, or OpenVINO."""

FlowRefinement = Literal["lucas_kanade", "dis", "none"]
"""The method that refines a network's flow."""

ScaleSource = Literal["network", "height"]
"""The source of the background's metric scale."""

HeightSource = Literal["range_finder", "barometer", "best"]
"""The source of the height above ground for this scale."""

OwnVelocitySource = Literal["vision", "autopilot"]
"""The source of a drone's own velocity."""

LensModel = Literal["pinhole", "wide_angle"]
"""A camera's projection: with OpenCV's radial-tangential distortion, or equidistant (Kannala-Brandt)."""
LENS_MODELS: tuple[LensModel, ...] = get_args(LensModel)

PixelFormat = Literal["mjpeg", "yuyv"]
"""Pixel formats of V4L2 cameras."""

ImageFormat = Literal["png", "jpeg"]
"""Compression of a recording's images."""

AutopilotMode = Literal["hold", "return", "land"]
"""Modes that flockd may request from the autopilot."""

SimulatedPerception = Literal["learned", "truth"]
"""Whether a simulated drone flies by its networks or by the simulator's state."""

CameraPreset = Literal["ideal", "realistic"]
"""Quality of a simulated drone's cameras."""

AutopilotKind = Literal["fake", "px4"]
"""The autopilot of a simulated fleet."""
