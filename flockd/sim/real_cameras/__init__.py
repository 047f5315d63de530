"""What real cameras make of ideal views: shutter, shake, lens faults, sensor, automatics, compression, timing."""

from flockd.sim.real_cameras.attitude import LateAttitude
from flockd.sim.real_cameras.real_camera import RealCamera, real_cameras
from flockd.sim.real_cameras.sensor import NoiseTile
from flockd.sim.real_cameras.shutter import CameraMotion, LensField
from flockd.sim.real_cameras.timing import Shot

__all__ = ["CameraMotion", "LateAttitude", "LensField", "NoiseTile", "RealCamera", "Shot", "real_cameras"]
