"""What real cameras make of ideal views: shutter, shake, lens faults, sensor, automatics, compression, timing."""

from flockd.sim.cameras.attitude import LateAttitude
from flockd.sim.cameras.real_camera import RealCamera, real_cameras
from flockd.sim.cameras.sensor import NoiseTile
from flockd.sim.cameras.shutter import CameraMotion, LensField
from flockd.sim.cameras.timing import Shot

__all__ = ["CameraMotion", "LateAttitude", "LensField", "NoiseTile", "RealCamera", "Shot", "real_cameras"]
