"""Camera models, rigid fits, Algorithm 1, ego- and neighbour motion. Pure: no clock, no files, the same every time."""

from flockd.geometry.cameras import Camera, PinholeCamera, WideAngleCamera
from flockd.geometry.ego_motion import estimate_ego_motion
from flockd.geometry.ego_motion_refinement import refine_ego_motion
from flockd.geometry.ground import ground_inverse_depth
from flockd.geometry.ground_fit import FittedGround, GroundSamples, fit_ground
from flockd.geometry.ground_track import scale_on_track
from flockd.geometry.neighbour_motion import estimate_neighbour_motion
from flockd.geometry.pairs import BACKGROUND_LABEL, PointPairs, grid_pixels, label_pixels, lift_matches
from flockd.geometry.polar import log_polar, log_polar_covariance, log_polar_residual
from flockd.geometry.rig import Rig, RigCamera, build_rig
from flockd.geometry.rigid_fit import fit_rigid
from flockd.geometry.robust.ransac import RansacResult, ransac_rigid
from flockd.geometry.rotations import euler_from_rotation, rotation_angle_deg, rotation_from_euler
from flockd.geometry.transform import RigidTransform
from flockd.geometry.triangulation import inverse_depths
from flockd.geometry.virtual_camera import VirtualCrop, virtual_crop

__all__ = [
    "BACKGROUND_LABEL",
    "Camera",
    "FittedGround",
    "GroundSamples",
    "PinholeCamera",
    "PointPairs",
    "RansacResult",
    "Rig",
    "RigCamera",
    "RigidTransform",
    "VirtualCrop",
    "WideAngleCamera",
    "build_rig",
    "estimate_ego_motion",
    "estimate_neighbour_motion",
    "euler_from_rotation",
    "fit_ground",
    "fit_rigid",
    "grid_pixels",
    "ground_inverse_depth",
    "inverse_depths",
    "label_pixels",
    "lift_matches",
    "log_polar",
    "log_polar_covariance",
    "log_polar_residual",
    "ransac_rigid",
    "refine_ego_motion",
    "rotation_angle_deg",
    "rotation_from_euler",
    "scale_on_track",
    "virtual_crop",
]
