"""A simulated drive in which everything is known: street, camera, LiDAR, motion and the moment of the drift.

``scene`` draws a street from a seed, ``camera`` and ``lidar`` cast rays against it, ``drive`` moves the
vehicle and hands out frames. World frame: x roughly along the road, y left, z up, metres.
"""
