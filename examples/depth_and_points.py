"""From a calibrated pair to depth in metres and a point cloud.

``python depth_and_points.py left.png right.png calib.txt`` takes a rectified pair with its calibration (Middlebury,
ETH3D, KITTI or JSON); without arguments it draws a synthetic street (``stereokit[scenes]``).
"""

import sys

import numpy as np

import stereokit
from stereokit.calibration import read_calibration

if len(sys.argv) == 4:
    left, right = (stereokit.read_image(path) for path in sys.argv[1:3])
    camera = read_calibration(sys.argv[3])
else:
    from stereokit_evaluation.synthetic.scenes import generate

    scene = generate(seed=0, width=621, height=188, max_disparity=64)
    left, right = scene.left, scene.right
    camera = stereokit.Calibration(scene.focal_px, scene.focal_px, scene.cx, scene.cy, scene.baseline_m)

result = stereokit.Matcher("S2", max_disparity=64)(left, right)
depth_m = result.depth(camera)  # of measured pixels only
near, middle, far = np.nanpercentile(depth_m, (5, 50, 95))
one_pixel = middle**2 / (camera.fx * camera.baseline_m)  # how far depth moves when disparity moves by one pixel
print(f"depth: {near:.1f} m to {far:.1f} m, median {middle:.1f} m, where one pixel is {one_pixel:.2f} m")

points_m = result.points(camera, max_depth=80, frame="y-up")  # what lies farther is mostly noise
usable = np.isfinite(points_m).all(axis=2)
colors = left if left.ndim == 3 else np.repeat(left[:, :, None], 3, axis=2)
stereokit.io.write_ply("points.ply", points_m[usable], colors[usable], "x right, y up, z backward; metres")
print(f"points.ply: {np.count_nonzero(usable)} points")
