"""Match a pair and write the disparity map, and a picture of it.

``python first_match.py left.png right.png`` takes a rectified pair of yours; without arguments it draws a synthetic
street (``stereokit[scenes]``).
"""

import sys

import stereokit

if len(sys.argv) == 3:
    left, right = (stereokit.read_image(path) for path in sys.argv[1:])
else:
    from stereokit_evaluation.synthetic.scenes import generate

    scene = generate(seed=0, width=621, height=188, max_disparity=64)
    left, right = scene.left, scene.right

matcher = stereokit.Matcher("S2", max_disparity=64)  # 0 <= disparity < 64 pixels
result = matcher(left, right)  # the first call on a machine compiles, once
print(f"{result.disparity.shape} {result.disparity.dtype}, {100 * result.density:.1f} % measured, the rest filled")

result.save("disparity.pfm")  # or .png as KITTI has it, .npy, .tiff
stereokit.io.write_image("disparity.jpg", result.color())
