"""Files: images, disparity maps (KITTI 16-bit PNG, PFM, npy, float TIFF), depth, OpenCV's fixed point, PLY clouds."""

from stereokit.io.atomic import check_output, make_folder, replacing, write_bytes
from stereokit.io.depth import DEPTH_SUFFIXES, read_depth, write_depth
from stereokit.io.disparity import DISPARITY_SUFFIXES, from_opencv, read_disparity, to_opencv, write_disparity
from stereokit.io.images import IMAGE_SUFFIXES, READABLE_SUFFIXES, read_image, read_pair, write_image
from stereokit.io.ply import write_ply
from stereokit.io.reading import parsing, read_bytes, read_json, read_npy, read_text
from stereokit.io.views import LAYOUTS, read_views, split_views

__all__ = [
    "DEPTH_SUFFIXES",
    "DISPARITY_SUFFIXES",
    "IMAGE_SUFFIXES",
    "LAYOUTS",
    "READABLE_SUFFIXES",
    "check_output",
    "from_opencv",
    "make_folder",
    "parsing",
    "read_bytes",
    "read_depth",
    "read_disparity",
    "read_image",
    "read_json",
    "read_npy",
    "read_pair",
    "read_text",
    "read_views",
    "replacing",
    "split_views",
    "to_opencv",
    "write_bytes",
    "write_depth",
    "write_disparity",
    "write_image",
    "write_ply",
]
