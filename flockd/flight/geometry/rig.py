"""The rig: every camera of the drone and its mounting in the body (FRD)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Set
from dataclasses import dataclass

import numpy as np

from flockd.core.config.rig import CameraConfig, RigConfig
from flockd.core.messages import BoolArray, FloatArray
from flockd.flight.geometry.cameras import Camera, PinholeCamera, WideAngleCamera
from flockd.flight.geometry.rotations import rotation_from_euler
from flockd.flight.geometry.transform import RigidTransform

R_FRD_RDF = np.eye(3)[[2, 0, 1]]
"""``R_body_camera`` of a camera that faces forward: the body's forward, right and down are its z, x and y."""


@dataclass(frozen=True, eq=False)
class RigCamera:
    """A camera and its mounting: ``T_body_camera`` takes optical RDF to body FRD."""

    name: str
    camera: Camera
    T_body_camera: RigidTransform

    def pixels_of_points(self, points_body: FloatArray) -> FloatArray:
        """(n, 2) pixels of body points (n, 3); NaN rows where the point is not in this camera's image."""
        return self.pixels_of_directions(np.asarray(points_body) - self.T_body_camera.translation)

    def pixels_of_directions(self, directions_body: FloatArray) -> FloatArray:
        """(n, 2) pixels of body directions (n, 3), as of points at infinity; NaN rows where not in the image."""
        pixels = self.camera.project((self.T_body_camera.rotation.T @ directions_body.T).T)
        pixels[~self.camera.in_image(pixels)] = np.nan
        return pixels


@dataclass(frozen=True, eq=False)
class Rig:
    """All cameras, by name."""

    cameras: Mapping[str, RigCamera]

    def covers(self, directions: FloatArray, without: Set[str] = frozenset()) -> BoolArray:
        """Mask (n,): body directions (n, 3) in view of any camera that is not in ``without``."""
        seen = np.zeros(len(directions), dtype=np.bool_)
        for name in self.cameras.keys() - without:
            seen |= np.isfinite(self.cameras[name].pixels_of_directions(directions)[:, 0])
            if seen.all():
                break
        return seen

    def shows(self, points_body: FloatArray, radius_m: float = 0.0, without: Set[str] = frozenset()) -> BoolArray:
        """Mask (n,): body points (n, 3) around which any camera not in ``without`` images all within `radius_m`."""
        shown = np.zeros(len(points_body), dtype=np.bool_)
        for name in self.cameras.keys() - without:
            shown |= _imaged(self.cameras[name], points_body, radius_m).all(axis=1)
        return shown

    def looking_at(self, points_body: FloatArray, radius_m: float) -> frozenset[str]:
        """The cameras that image something within `radius_m` of any of these body points (n, 3)."""
        return frozenset(name for name, one in self.cameras.items() if _imaged(one, points_body, radius_m).any())


def _imaged(camera: RigCamera, points_body: FloatArray, radius_m: float) -> BoolArray:
    """(n, k) which points `radius_m` to the camera's right, left, top and bottom of each point it images; without a
    radius, the point."""
    sides = radius_m * camera.T_body_camera.rotation[:, :2].T
    around = points_body[:, None] + (np.concatenate([sides, -sides]) if radius_m else np.zeros((1, 3)))
    uv = camera.pixels_of_points(around.reshape(-1, 3)).reshape(*around.shape[:2], 2)
    return np.asarray(np.isfinite(uv).all(axis=2))


def build_rig(config: RigConfig) -> Rig:
    """The rig of a configuration. Raises ValueError if a camera's intrinsics are invalid."""
    return Rig({camera.name: _build_camera(camera) for camera in config.cameras})


def _build_camera(config: CameraConfig) -> RigCamera:
    intrinsics, extrinsics = config.intrinsics, config.extrinsics
    matrix = np.array([[intrinsics.fx, 0.0, intrinsics.cx], [0.0, intrinsics.fy, intrinsics.cy], [0.0, 0.0, 1.0]])
    model = PinholeCamera if intrinsics.model == "pinhole" else WideAngleCamera
    turn = rotation_from_euler(
        math.radians(extrinsics.roll_deg), math.radians(extrinsics.pitch_deg), math.radians(extrinsics.yaw_deg)
    )
    return RigCamera(
        name=config.name,
        camera=model(matrix, config.size_px, intrinsics.distortion),
        T_body_camera=RigidTransform(turn @ R_FRD_RDF, np.array(extrinsics.position_m)),
    )
