"""Weights of stereokit's refiners that were tuned to KITTI: CC BY-NC-SA 3.0, not for commercial use.

``stereokit.match(left, right, "S4", scale=0.5, refiner="stereovae", weights="kitti")`` uses them.
"""
