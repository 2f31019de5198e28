"""Match a stereo video, both views side by side in one file, frame by frame and several frames at a time."""

import cv2
import numpy as np

import stereokit

# A small video to work on: a textured wall that comes nearer. Yours has a name; leave this out.
wall = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 256, (96, 240), dtype=np.uint8), (0, 0), 1.5)
writer = cv2.VideoWriter("stereo.avi", cv2.VideoWriter_fourcc(*"MJPG"), 10, (320, 96))
for near in range(4, 12):
    both = np.hstack([wall[:, 40:200], wall[:, 40 + near : 200 + near]])
    writer.write(cv2.cvtColor(both, cv2.COLOR_GRAY2BGR))
writer.release()


def frames(path):
    """Yield the left and the right view of each frame, RGB."""
    capture = cv2.VideoCapture(path)
    while True:
        there, frame = capture.read()
        if not there:
            return
        half = frame.shape[1] // 2
        yield frame[:, :half, ::-1], frame[:, half:, ::-1]


matcher = stereokit.Matcher("S2", max_disparity=32)
colored = cv2.VideoWriter("disparity.avi", cv2.VideoWriter_fourcc(*"MJPG"), 10, (160, 96))
for number, result in enumerate(matcher.map(frames("stereo.avi"))):  # in order, in bounded memory
    print(f"frame {number}: median disparity {np.median(result.disparity):.1f} px, measured {result.density:.0%}")
    colored.write(cv2.cvtColor(result.color(min=0, max=32), cv2.COLOR_RGB2BGR))  # one scale for all frames
colored.release()
