"""stereokit and OpenCV's StereoSGBM: the same pair, timed in turns, with the differences in units and gaps.

``python beside_opencv.py left.png right.png`` takes a rectified pair; without arguments it draws a synthetic street.
"""

import sys
import timeit

import cv2
import numpy as np

import stereokit

if len(sys.argv) == 3:
    left, right = (stereokit.read_image(path, gray=True) for path in sys.argv[1:])
else:
    from stereokit_evaluation.synthetic.scenes import generate

    scene = generate(seed=0, width=621, height=188, max_disparity=64)
    left, right = (cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in (scene.left, scene.right))
cv2.setNumThreads(1)  # as many as the matcher below
sgbm = cv2.StereoSGBM_create(0, 64, 5, P1=200, P2=800, mode=cv2.StereoSGBM_MODE_SGBM_3WAY)
matcher = stereokit.Matcher("S2", max_disparity=64, threads=1)
calls = {"OpenCV 3WAY": lambda: sgbm.compute(left, right), "stereokit S2": lambda: matcher(left, right)}
outputs = {name: call() for name, call in calls.items()}  # the first call compiles: not timed
times = {name: [] for name in calls}
for _ in range(9):
    for name, call in calls.items():  # in turns, so that a busy moment of the machine hits both
        times[name].append(timeit.timeit(call, number=1))
# OpenCV: int16 in sixteenths of a pixel, and (minDisparity - 1) * 16, here -16, where there is no disparity.
# stereokit: float32 in pixels, dense; .valid is True at measured pixels, the others are filled from their rows.
result = outputs["stereokit S2"]
opencv = stereokit.io.from_opencv(outputs["OpenCV 3WAY"])  # float32 pixels, NaN where there is none
maps = {"OpenCV 3WAY": opencv, "stereokit S2": np.where(result.valid, result.disparity, np.nan)}
for name, disparity in maps.items():
    print(f"{name}: {1000 * np.median(times[name]):.1f} ms, {100 * np.isfinite(disparity).mean():.0f} % measured")
apart = np.abs(maps["OpenCV 3WAY"] - maps["stereokit S2"])
print(f"where both measured, {100 * np.mean(apart[np.isfinite(apart)] < 1):.1f} % agree within a pixel")
