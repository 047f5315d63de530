"""Depth maps: range along the ray inside flockd, z along the optical axis outside, and that of plane ground.

The ground's inverse depth in every pixel, from attitude and height, gives depth its metric scale.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NewType

import numpy as np
from numpy.typing import ArrayLike

from flockd.core.messages import Float32Array, FloatArray
from flockd.flight.geometry.cameras import Camera
from flockd.flight.geometry.rig import RigCamera

ZMap = NewType("ZMap", Float32Array)
"""(h, w) metres along the optical axis: the output of networks, renderers and depth cameras."""
RangeMap = NewType("RangeMap", Float32Array)
"""(h, w) metres along each pixel's ray, as `Camera.unproject` takes them: used everywhere in flockd."""


def range_map(z: ZMap, camera: Camera) -> RangeMap:
    """The ranges of a map of the camera's size; NaN outside the lens's image, and 90 degrees or more off its axis."""
    return RangeMap(z / _axial_share(camera))


@lru_cache(maxsize=32)
def _axial_share(camera: Camera) -> Float32Array:
    """(h, w) z over range of each pixel; NaN outside the lens's image, or if it is not positive."""
    share = camera.block_rays(1)[..., 2]
    return np.where(share > 0.0, share, np.nan).astype(np.float32)


def ground_inverse_depth(
    camera: RigCamera, R_ned_body: FloatArray, height_m: float, slope: ArrayLike = (0.0, 0.0), *, stride: int = 1
) -> Float32Array:
    """(h, w) inverse depth, 1/m, of plane ground ``height_m`` straight below the body's origin; 0 above the horizon.

    ``slope`` is the plane's rise per metre to the north and to the east. Depth is z, along the optical axis, as in
    networks. With ``stride`` the map is (h / stride, w / stride), each pixel for the centre of a block. Raises
    ValueError if the camera is not above the ground or ``stride`` does not divide the image.
    """
    normal = np.append(slope, 1.0)  # a point p in level axes is on the ground if n . p is the height
    camera_height_m = height_m - float(normal @ R_ned_body @ camera.T_body_camera.translation)
    if not camera_height_m > 0.0:
        raise ValueError(f"camera {camera.name!r} is not above the ground: its height is {camera_height_m:.2f} m")
    towards_camera = normal @ (R_ned_body @ camera.T_body_camera.rotation)
    # A point at z = d is d times its ray, and on the ground if d (ray . n) is the camera's height.
    inverse_depth = _rays_of_unit_depth(camera, stride) @ (towards_camera / camera_height_m).astype(np.float32)
    # NaN, outside a lens's image circle, compares false.
    return np.where(inverse_depth > 0.0, inverse_depth, np.float32(0.0))


@lru_cache(maxsize=32)
def _rays_of_unit_depth(camera: RigCamera, stride: int) -> Float32Array:
    """(h / stride, w / stride, 3) points at z = 1 on the rays of the blocks' centres, RDF; NaN outside the image."""
    width, height = camera.camera.size
    if stride < 1 or width % stride or height % stride:
        raise ValueError(f"a stride of {stride} does not divide an image of {width}x{height}")
    rays = camera.camera.block_rays(stride)
    return (rays / np.where(rays[..., 2:] > 0.0, rays[..., 2:], np.nan)).astype(np.float32)
