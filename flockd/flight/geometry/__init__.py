"""Camera models, rigid fits, Algorithm 1, ego- and neighbour motion. Pure and deterministic: no clock, no files."""

from flockd.flight.geometry.cameras import Camera, PinholeCamera, WideAngleCamera
from flockd.flight.geometry.depth_maps import RangeMap, ZMap, ground_inverse_depth, range_map
from flockd.flight.geometry.ego_motion import estimate_ego_motion, moved_pixels
from flockd.flight.geometry.pairs import PointPairs, grid_pixels, lift_matches
from flockd.flight.geometry.polar import log_polar, log_polar_covariance, log_polar_residual
from flockd.flight.geometry.rig import R_FRD_RDF, Rig, RigCamera, build_rig
from flockd.flight.geometry.rigid_fit import fit_rigid
from flockd.flight.geometry.robust.ransac import ransac_rigid
from flockd.flight.geometry.rotations import (
    euler_from_rotation,
    quaternion_from_rotation,
    rotation_angle_deg,
    rotation_from_euler,
    rotation_from_quaternion,
    rotation_from_vector,
    vector_from_rotation,
)
from flockd.flight.geometry.sightlines import inverse_ranges_of_rays
from flockd.flight.geometry.transform import RigidTransform
from flockd.flight.geometry.virtual_camera import VirtualCrops, virtual_crops

__all__ = [
    "R_FRD_RDF",
    "Camera",
    "PinholeCamera",
    "PointPairs",
    "RangeMap",
    "Rig",
    "RigCamera",
    "RigidTransform",
    "VirtualCrops",
    "WideAngleCamera",
    "ZMap",
    "build_rig",
    "estimate_ego_motion",
    "euler_from_rotation",
    "fit_rigid",
    "grid_pixels",
    "ground_inverse_depth",
    "inverse_ranges_of_rays",
    "lift_matches",
    "log_polar",
    "log_polar_covariance",
    "log_polar_residual",
    "moved_pixels",
    "quaternion_from_rotation",
    "range_map",
    "ransac_rigid",
    "rotation_angle_deg",
    "rotation_from_euler",
    "rotation_from_quaternion",
    "rotation_from_vector",
    "vector_from_rotation",
    "virtual_crops",
]
