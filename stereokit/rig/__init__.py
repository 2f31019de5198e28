"""Two raw cameras: their lenses, how they stand to each other, the rectified pair that comes of it, calibrating."""

from stereokit.rig.files import read_rig
from stereokit.rig.model import Camera, StereoRig
from stereokit.rig.rectification import Rectification

__all__ = ["Camera", "Rectification", "StereoRig", "read_rig"]
