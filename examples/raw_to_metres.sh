#!/bin/sh
# From two raw cameras to metres: sh raw_to_metres.sh, in a folder with
#   board/left01.png, board/right01.png, ...  pairs of a chessboard of 9x6 inner corners, 25 mm apart
#   raw/left01.png, raw/right01.png, ...      pairs of what shall be measured

# 1. What the lenses are, and how the cameras stand: rig.yml. rig-rows.png shows how well the rows meet.
stereokit calibrate board --board 9x6 --square 25mm -o rig.yml

# 2. Raw views do not fit each other; rectified ones do. The exit status of check says so.
stereokit check raw/left01.png raw/right01.png --max-disparity 96 || echo "as raw views are"
stereokit rectify raw --rig rig.yml -o rectified
stereokit check rectified/left/01.png rectified/right/01.png --max-disparity 96

# 3. Disparity, depth in millimetres and points in metres of a raw pair, in one step.
stereokit match raw/left01.png raw/right01.png --rig rig.yml -o disparity.pfm --max-disparity 96 --color disparity.png --depth depth.png --ply points.ply

# 4. The points, upright, where Open3D is installed (pip install open3d).
python -c "import open3d; open3d.visualization.draw_geometries([open3d.io.read_point_cloud('points.ply')])" || echo "no Open3D, or no display"

# 5. The same live: a page on this machine, with the depth under the pointer. Cameras are 0 and 1 instead of the folder.
stereokit live raw --rig rig.yml --max-disparity 96 --fps 2 --until-end
